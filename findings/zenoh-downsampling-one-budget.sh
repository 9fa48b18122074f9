#!/usr/bin/env bash
# eclipse-zenoh 1.10.2: a downsampling rule has one budget for all keys that its expression covers. Of two robots that
# publish one after the other at 50 Hz, a rule of 10 Hz for park/*/pose lets the first through and nothing of the second.
# Guess: the rate holds for each key. A rule for each robot does what is meant.
# Seen: one rule: A passes, B nothing; a rule for each: both pass
set -euo pipefail
place=$(mktemp -d); trap 'rm -rf "$place"' EXIT
python3 -m venv "$place/venv"
"$place/venv/bin/pip" install --quiet eclipse-zenoh==1.10.2
cat > "$place/seen.py" <<'END'
import json
import time
from collections import Counter

import zenoh

zenoh.init_log_from_env_or("error")
PLACE = "tcp/127.0.0.1:27449"


def settings(mode, keys=()):
    made = zenoh.Config()
    made.insert_json5("mode", f'"{mode}"')
    made.insert_json5("scouting/multicast/enabled", "false")
    made.insert_json5("listen/endpoints" if mode == "router" else "connect/endpoints", f'["{PLACE}"]')
    if keys:
        rules = [{"key_expr": key, "freq": 10.0} for key in keys]
        made.insert_json5("downsampling", json.dumps([{"messages": ["put"], "flows": ["egress"], "rules": rules}]))
    return made


for name, keys in (("one rule", ["park/*/pose"]), ("a rule for each", ["park/A/pose", "park/B/pose"])):
    with zenoh.open(settings("router", keys)), zenoh.open(settings("client")) as robots, \
            zenoh.open(settings("client")) as reader:
        received = Counter()
        subscriber = reader.declare_subscriber("park/*/pose", lambda sample: received.update([str(sample.key_expr)]))
        time.sleep(0.5)
        for _ in range(100):
            for robot in "AB":
                robots.put(f"park/{robot}/pose", "")
            time.sleep(0.02)
        time.sleep(0.5)
        print(name, *(received[f"park/{robot}/pose"] > 5 for robot in "AB"))
END
seen=$("$place/venv/bin/python" "$place/seen.py")
printf '%s\n' "$seen"
[ "$seen" = "one rule True False
a rule for each True True" ] || { echo "the behaviour has changed" >&2; exit 1; }
