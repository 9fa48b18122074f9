#!/usr/bin/env bash
# networkx 3.6.1, igraph 1.0.0: GraphML may give a value once for all edges that have none of their own, <default>.
# igraph reads it into each edge; networkx reads it into graph["edge_default"] alone, and the edge has no distance.
# Guess: one file, one graph. A formation of 0.6 m from an editor has links without a distance in networkx.
# Seen: networkx {} and 1.0, igraph 0.6 and 1.0
set -euo pipefail
place=$(mktemp -d); trap 'rm -rf "$place"' EXIT
python3 -m venv "$place/venv"
"$place/venv/bin/pip" install --quiet networkx==3.6.1 igraph==1.0.0
cat > "$place/seen.py" <<'END'
import sys
from pathlib import Path

import igraph
import networkx

file = Path(sys.argv[0]).with_suffix(".graphml")
file.write_text("""<graphml xmlns="http://graphml.graphdrawing.org/xmlns">
<key id="d" for="edge" attr.name="distance" attr.type="double"><default>0.6</default></key>
<graph edgedefault="undirected"><node id="R1"/><node id="R2"/><node id="R3"/>
<edge source="R1" target="R2"/><edge source="R2" target="R3"><data key="d">1.0</data></edge></graph></graphml>
""")
graph = networkx.read_graphml(file)
print("networkx", [graph.edges[edge] for edge in graph.edges], graph.graph["edge_default"])
print("igraph", igraph.Graph.Read_GraphML(str(file)).es["distance"])
END
seen=$("$place/venv/bin/python" "$place/seen.py")
printf '%s\n' "$seen"
[ "$seen" = "networkx [{}, {'distance': 1.0}] {'distance': 0.6}
igraph [0.6, 1.0]" ] || { echo "the behaviour has changed" >&2; exit 1; }
