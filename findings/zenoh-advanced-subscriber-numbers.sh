#!/usr/bin/env bash
# eclipse-zenoh 1.10.2: an advanced subscriber believes the source number of any sample, of ordinary publishers too, and
# drops without a word what does not grow. A publisher that sends a constant number is received once, and goes silent.
# Guess: without history of its own such a publisher is passed on as by a plain subscriber.
# Seen: no number 10 and 10; one number 10 and 1; numbers that grow 10 and 10
set -euo pipefail
place=$(mktemp -d); trap 'rm -rf "$place"' EXIT
python3 -m venv "$place/venv"
"$place/venv/bin/pip" install --quiet eclipse-zenoh==1.10.2
cat > "$place/seen.py" <<'END'
import time

import zenoh
from zenoh.ext import HistoryConfig, declare_advanced_subscriber

zenoh.init_log_from_env_or("error")


def settings(mode, place):
    made = zenoh.Config()
    made.insert_json5("mode", f'"{mode}"')
    made.insert_json5("scouting/multicast/enabled", "false")
    made.insert_json5("listen/endpoints" if mode == "router" else "connect/endpoints", f'["{place}"]')
    return made


PLACE = "tcp/127.0.0.1:27447"
with zenoh.open(settings("router", PLACE)), zenoh.open(settings("client", PLACE)) as sender, \
        zenoh.open(settings("client", PLACE)) as receiver:
    plain, advanced = [], []
    receiver.declare_subscriber("robot/*", plain.append)
    declare_advanced_subscriber(receiver, "robot/*", advanced.append, history=HistoryConfig())
    publisher = sender.declare_publisher("robot/pose")  # an ordinary one
    time.sleep(1.0)
    for what, number in (("no number", None), ("one number", 0), ("numbers that grow", 1)):
        for k in range(10):
            source = None if number is None else zenoh.SourceInfo(publisher.id, number * (k + 1))
            publisher.put(str(k), source_info=source)
            time.sleep(0.02)
        time.sleep(0.5)
        print(f"{what}: plain {len(plain)}, advanced {len(advanced)}")
        plain.clear()
        advanced.clear()
END
seen=$("$place/venv/bin/python" "$place/seen.py")
printf '%s\n' "$seen"
[ "$seen" = "no number: plain 10, advanced 10
one number: plain 10, advanced 1
numbers that grow: plain 10, advanced 10" ] || { echo "the behaviour has changed" >&2; exit 1; }
