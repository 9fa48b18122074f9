#!/usr/bin/env bash
# rosbags 0.11.9: the bytes of an array go into a message as they are, whatever numbers they stand for: whole numbers in
# a field of float64, as np.array([1, 2]) makes them, are read back as 5e-324 and 1e-323, and numbers in big-endian order
# as others. Guess: they are converted, or refused as float32 is. Nothing is said at writing nor at reading.
# Seen: int64 [5e-324, 1e-323]; big-endian wrong; float32 ValueError; float64 [1.0, 2.0]
set -euo pipefail
place=$(mktemp -d); trap 'rm -rf "$place"' EXIT
python3 -m venv "$place/venv"
"$place/venv/bin/pip" install --quiet rosbags==0.11.9 numpy==2.4.6
cat > "$place/seen.py" <<'END'
import numpy as np
from rosbags.typesys import Stores, get_typestore

store, kind = get_typestore(Stores.ROS2_HUMBLE), "std_msgs/msg/Float64MultiArray"
layout = store.types["std_msgs/msg/MultiArrayLayout"]([], 0)
for name, numbers in (
    ("float64", np.array([1.0, 2.0])),
    ("int64", np.array([1, 2], dtype="<i8")),
    ("big-endian", np.array([1.0, 2.0], dtype=">f8")),
    ("float32", np.array([1.0, 2.0], dtype="<f4")),
):
    try:
        read = store.deserialize_cdr(store.serialize_cdr(store.types[kind](layout, numbers), kind), kind)
        print(name, read.data.tolist())
    except ValueError:
        print(name, "ValueError")
END
seen=$("$place/venv/bin/python" "$place/seen.py")
printf '%s\n' "$seen"
[ "$seen" = "float64 [1.0, 2.0]
int64 [5e-324, 1e-323]
big-endian [3.03865e-319, 3.16e-322]
float32 ValueError" ] || { echo "the behaviour has changed" >&2; exit 1; }
