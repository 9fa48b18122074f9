#!/usr/bin/env bash
# eclipse-zenoh 1.10.2: the cache of an advanced publisher answers a late subscriber with its delete() as a PUT of zero
# bytes. Who was there in time gets a DELETE. Guess: the history holds the kind of a sample.
# A reader that takes an empty payload for damage, or ignores it, goes on with the value that was deleted.
# Seen: early PUT, DELETE; late PUT, PUT of 0 bytes
set -euo pipefail
place=$(mktemp -d); trap 'rm -rf "$place"' EXIT
python3 -m venv "$place/venv"
"$place/venv/bin/pip" install --quiet eclipse-zenoh==1.10.2
cat > "$place/seen.py" <<'END'
import time

import zenoh
from zenoh.ext import CacheConfig, HistoryConfig, declare_advanced_publisher, declare_advanced_subscriber

zenoh.init_log_from_env_or("error")


def settings(mode, place):
    made = zenoh.Config()
    made.insert_json5("mode", f'"{mode}"')
    made.insert_json5("timestamping/enabled", "true")
    made.insert_json5("scouting/multicast/enabled", "false")
    made.insert_json5("listen/endpoints" if mode == "router" else "connect/endpoints", f'["{place}"]')
    return made


PLACE = "tcp/127.0.0.1:27448"
with zenoh.open(settings("router", PLACE)), zenoh.open(settings("client", PLACE)) as sender, \
        zenoh.open(settings("client", PLACE)) as receiver:
    seen = {"early": [], "late": []}

    def subscribe(who):
        def note(sample):
            seen[who].append((str(sample.kind).rpartition(".")[2], len(sample.payload)))

        return declare_advanced_subscriber(receiver, "robot/pose", note, history=HistoryConfig())

    early = subscribe("early")
    publisher = declare_advanced_publisher(sender, "robot/pose", cache=CacheConfig(max_samples=5))
    time.sleep(1.0)
    publisher.put("1")
    publisher.delete()
    time.sleep(0.5)
    late = subscribe("late")
    time.sleep(1.0)
    for who, samples in seen.items():
        print(who, samples)
END
seen=$("$place/venv/bin/python" "$place/seen.py")
printf '%s\n' "$seen"
[ "$seen" = "early [('PUT', 1), ('DELETE', 0)]
late [('PUT', 1), ('PUT', 0)]" ] || { echo "the behaviour has changed" >&2; exit 1; }
