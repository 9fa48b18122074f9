#!/usr/bin/env bash
# msgspec 0.22.0: a float64 of numpy is no float to msgspec, though isinstance says so, neither written nor converted.
# The json of the standard library writes it. Guess: subclasses of float are written as floats. A message breaks at the
# first number that came out of numpy, such as a norm, deep in its lists; float(...) helps.
# Seen: json 0.5; msgspec encode TypeError, convert ValidationError; with float 0.5
set -euo pipefail
place=$(mktemp -d); trap 'rm -rf "$place"' EXIT
python3 -m venv "$place/venv"
"$place/venv/bin/pip" install --quiet msgspec==0.22.0 numpy==2.4.6
cat > "$place/seen.py" <<'END'
import json

import msgspec
import numpy as np

distance = np.linalg.norm([0.3, 0.4])
print("is a float", isinstance(distance, float), "json", json.dumps(distance))
for name, write in (("encode", msgspec.json.encode), ("convert", lambda value: msgspec.convert(value, float))):
    try:
        print(name, write(distance))
    except (TypeError, msgspec.ValidationError) as error:
        print(name, type(error).__name__)
    print(name, "float", write(float(distance)))
END
seen=$("$place/venv/bin/python" "$place/seen.py")
printf '%s\n' "$seen"
[ "$seen" = "is a float True json 0.5
encode TypeError
encode float b'0.5'
convert ValidationError
convert float 0.5" ] || { echo "the behaviour has changed" >&2; exit 1; }
