#!/usr/bin/env bash
# networkx 3.6.1: the Laplacian of a directed graph counts the edges that leave a node. With an edge from the leader to
# its follower, in the way that messages go, the consensus law x' = -L x moves the leader to the follower, and the
# follower stays. Guess: the follower follows. It does by the Laplacian of graph.reverse(), whose edges point at the
# speaker.
# Seen: leader 0.0, follower 0.0 from 1 and 0; reversed 1.0 and 1.0
set -euo pipefail
place=$(mktemp -d); trap 'rm -rf "$place"' EXIT
python3 -m venv "$place/venv"
"$place/venv/bin/pip" install --quiet networkx==3.6.1 numpy==2.4.6 scipy==1.17.1
cat > "$place/seen.py" <<'END'
import networkx
import numpy as np

ROBOTS = ["leader", "follower"]
graph = networkx.DiGraph([ROBOTS])
for name, way in (("as messages go", graph), ("reversed", graph.reverse())):
    laplacian = networkx.laplacian_matrix(way, nodelist=ROBOTS).toarray()
    places = np.array([1.0, 0.0])
    for _ in range(1000):
        places = places - 0.01 * laplacian @ places
    print(name, *places.round(2))
END
seen=$("$place/venv/bin/python" "$place/seen.py")
printf '%s\n' "$seen"
[ "$seen" = "as messages go 0.0 0.0
reversed 1.0 1.0" ] || { echo "the behaviour has changed" >&2; exit 1; }
