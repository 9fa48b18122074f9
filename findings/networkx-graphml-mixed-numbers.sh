#!/usr/bin/env bash
# networkx 3.6.1, igraph 1.0.0: a graph whose edges have distances 1, 0.5 and 2 is written by networkx with two keys of
# one name, long and double, of which igraph refuses the file. networkx reads it back as it was. Guess: a number is a
# number. Distances written as 1.0, 0.5, 2.0 are one key, and igraph reads them.
# Seen: mixed: InternalError, Duplicate attribute name found; floats: [1.0, 2.0, 0.5]
set -euo pipefail
place=$(mktemp -d); trap 'rm -rf "$place"' EXIT
python3 -m venv "$place/venv"
"$place/venv/bin/pip" install --quiet networkx==3.6.1 igraph==1.0.0
cat > "$place/seen.py" <<'END'
import sys
from pathlib import Path

import igraph
import networkx

LINKS = {("R1", "R2"): 1, ("R2", "R3"): 0.5, ("R3", "R1"): 2}
for name, kind in (("mixed", lambda number: number), ("floats", float)):
    graph, file = networkx.Graph(), Path(sys.argv[1], f"{name}.graphml")
    for (one, other), distance in LINKS.items():
        graph.add_edge(one, other, distance=kind(distance))
    networkx.write_graphml(graph, file)
    assert {(*edge,): of["distance"] for *edge, of in networkx.read_graphml(file).edges(data=True)} == {
        edge: graph.edges[edge]["distance"] for edge in graph.edges
    }
    try:
        print(name, igraph.Graph.Read_GraphML(str(file)).es["distance"])
    except igraph.InternalError as error:
        print(name, type(error).__name__, "Duplicate attribute name found" in str(error))
END
seen=$("$place/venv/bin/python" "$place/seen.py" "$place")
printf '%s\n' "$seen"
[ "$seen" = "mixed InternalError True
floats [1.0, 2.0, 0.5]" ] || { echo "the behaviour has changed" >&2; exit 1; }
