#!/usr/bin/env bash
# igraph 1.0.0: Graph.Adjacency takes the numbers of a matrix for counts of edges: weights below 1 make no edge, 2 makes two,
# 1.9 makes one. Guess: an edge where the number is not 0, as networkx.from_numpy_array has it, with the number as its
# weight. The graph of a formation with distances of 0.5 m has no edges. Weighted_Adjacency keeps weights.
# Seen: matrix of 0.5: no edge; of 2.0: 4 edges; Weighted_Adjacency and networkx one edge of each pair
set -euo pipefail
place=$(mktemp -d); trap 'rm -rf "$place"' EXIT
python3 -m venv "$place/venv"
"$place/venv/bin/pip" install --quiet igraph==1.0.0 networkx==3.6.1 numpy==2.4.6
cat > "$place/seen.py" <<'END'
import igraph
import networkx
import numpy as np

for weight in (0.5, 2.0):
    matrix = np.array([[0.0, weight], [weight, 0.0]])
    counted = igraph.Graph.Adjacency(matrix)
    weighted = igraph.Graph.Weighted_Adjacency(matrix, mode="undirected")
    print(weight, counted.ecount(), weighted.es["weight"], *networkx.from_numpy_array(matrix).edges(data="weight"))
END
seen=$("$place/venv/bin/python" "$place/seen.py")
printf '%s\n' "$seen"
[ "$seen" = "0.5 0 [0.5] (0, 1, 0.5)
2.0 4 [2.0] (0, 1, 2.0)" ] || { echo "the behaviour has changed" >&2; exit 1; }
