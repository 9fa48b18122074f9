#!/usr/bin/env bash
# pykdtree 1.4.3: asked for more neighbours than there are points, it gives finite distances for those that are missing.
# Guess: infinity and the number of points, as scipy gives, and as pykdtree itself gives for a limit of distance. Code
# that leaves out what is infinitely far takes 1.3e154 m for a neighbour.
# Seen: without a limit 1.34e+154 and 4294967295, finite; with one inf and 2; scipy 1.17.1 inf and 2 in both
set -euo pipefail
place=$(mktemp -d); trap 'rm -rf "$place"' EXIT
python3 -m venv "$place/venv"
"$place/venv/bin/pip" install --quiet pykdtree==1.4.3 numpy==2.4.6 scipy==1.17.1
cat > "$place/seen.py" <<'END'
import numpy as np
import pykdtree.kdtree
import scipy.spatial

ROBOTS = np.array([[0.0, 0.0], [1.0, 0.0]])
for name, tree in (("pykdtree", pykdtree.kdtree.KDTree(ROBOTS)), ("scipy", scipy.spatial.KDTree(ROBOTS))):
    for limit in ({}, {"distance_upper_bound": 5.0}):
        far, which = tree.query(np.array([[0.1, 0.0]]), k=3, **limit)
        print(name, *limit, f"{far[0, 2]:.3g}", int(which[0, 2]), bool(np.isinf(far[0, 2])))
END
seen=$("$place/venv/bin/python" "$place/seen.py")
printf '%s\n' "$seen"
[ "$seen" = "pykdtree 1.34e+154 4294967295 False
pykdtree distance_upper_bound inf 2 True
scipy inf 2 True
scipy distance_upper_bound inf 2 True" ] || { echo "the behaviour has changed" >&2; exit 1; }
