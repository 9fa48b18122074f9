#!/usr/bin/env bash
# networkit 11.3: the Laplacian of a graph keeps a row of zeros for each removed node. Guess: three nodes are left, and
# the matrix is 3 x 3. Its second eigenvalue, the algebraic connectivity, is 0: a formation whose fourth robot has
# left is called disconnected, although all that are left hear one another.
# Seen: 3 nodes, 1 component, Laplacian 4 x 4 with eigenvalues 0, 0, 3, 3
set -euo pipefail
place=$(mktemp -d); trap 'rm -rf "$place"' EXIT
python3 -m venv "$place/venv"
"$place/venv/bin/pip" install --quiet networkit==11.3
cat > "$place/seen.py" <<'END'
import itertools

import networkit
import numpy as np

graph = networkit.Graph(4)
for one, other in itertools.combinations(range(4), 2):
    graph.addEdge(one, other)
graph.removeNode(1)
matrix = networkit.algebraic.laplacianMatrix(graph).toarray()
parts = networkit.components.ConnectedComponents(graph).run().numberOfComponents()
values = [round(abs(value), 6) for value in np.linalg.eigvalsh(matrix).tolist()]
print(graph.numberOfNodes(), parts, matrix.shape, values)
END
seen=$("$place/venv/bin/python" "$place/seen.py")
printf '%s\n' "$seen"
[ "$seen" = "3 1 (4, 4) [0.0, 0.0, 3.0, 3.0]" ] || { echo "the behaviour has changed" >&2; exit 1; }
