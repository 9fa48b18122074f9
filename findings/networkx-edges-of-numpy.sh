#!/usr/bin/env bash
# networkx 3.6.1: distances that numpy computed, such as np.linalg.norm gives, are written into edge lists and GML as
# np.float64(0.5), and networkx cannot read its own file back. Guess: a float64 is a float, as it is in GraphML. Who
# saves formations so loses nothing, and gets nothing back. float(...) helps.
# Seen: edge list TypeError, GML NetworkXError, GraphML 0.5; with float 0.5 from all three
set -euo pipefail
place=$(mktemp -d); trap 'rm -rf "$place"' EXIT
python3 -m venv "$place/venv"
"$place/venv/bin/pip" install --quiet networkx==3.6.1 numpy==2.4.6
cat > "$place/seen.py" <<'END'
import sys
from pathlib import Path

import networkx
import numpy as np

for kind in (np.float64, float):
    graph = networkx.Graph()
    graph.add_edge("R1", "R2", distance=kind(np.linalg.norm([0.3, 0.4])))
    for form in ("edgelist", "gml", "graphml"):
        file = Path(sys.argv[0]).with_suffix(f".{form}")
        getattr(networkx, f"write_{form}")(graph, file)
        try:
            print(kind.__name__, form, getattr(networkx, f"read_{form}")(file).edges["R1", "R2"]["distance"])
        except (TypeError, networkx.NetworkXError) as error:
            print(kind.__name__, form, type(error).__name__)
END
seen=$("$place/venv/bin/python" "$place/seen.py")
printf '%s\n' "$seen"
[ "$seen" = "float64 edgelist TypeError
float64 gml NetworkXError
float64 graphml 0.5
float edgelist 0.5
float gml 0.5
float graphml 0.5" ] || { echo "the behaviour has changed" >&2; exit 1; }
