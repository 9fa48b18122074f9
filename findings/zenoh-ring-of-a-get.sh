#!/usr/bin/env bash
# eclipse-zenoh 1.10.2: replies that wait in a RingChannel are gone when the get has ended; a FifoChannel keeps them until
# they are taken. Guess: a ring keeps its last replies, as it does for a subscriber.
# Seen: FifoChannel 3 replies; RingChannel none, ZError
set -euo pipefail
place=$(mktemp -d); trap 'rm -rf "$place"' EXIT
python3 -m venv "$place/venv"
"$place/venv/bin/pip" install --quiet eclipse-zenoh==1.10.2
cat > "$place/seen.py" <<'END'
import time

import zenoh
from zenoh.handlers import FifoChannel, RingChannel

zenoh.init_log_from_env_or("error")
PLACE = "tcp/127.0.0.1:27450"


def settings(mode):
    made = zenoh.Config()
    made.insert_json5("mode", f'"{mode}"')
    made.insert_json5("scouting/multicast/enabled", "false")
    made.insert_json5("listen/endpoints" if mode == "router" else "connect/endpoints", f'["{PLACE}"]')
    return made


def reply(query):
    for number in range(3):
        query.reply(f"robot/{number}", str(number))


with zenoh.open(settings("router")), zenoh.open(settings("client")) as robot, zenoh.open(settings("client")) as reader:
    queryable = robot.declare_queryable("robot/**", reply)
    time.sleep(0.5)
    for channel in (FifoChannel(10), RingChannel(10)):
        replies, taken, why = reader.get("robot/**", channel), 0, ""
        time.sleep(1.0)
        try:
            while replies.try_recv() is not None:
                taken += 1
        except zenoh.ZError as error:
            why = "deleted" if "deleted" in str(error) else "empty and closed"
        print(type(channel).__name__, taken, why)
END
seen=$("$place/venv/bin/python" "$place/seen.py")
printf '%s\n' "$seen"
[ "$seen" = "FifoChannel 3 empty and closed
RingChannel 0 deleted" ] || { echo "the behaviour has changed" >&2; exit 1; }
