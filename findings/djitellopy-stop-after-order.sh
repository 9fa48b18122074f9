#!/usr/bin/env bash
# djitellopy 2.5.0: send_rc_control sends nothing within a millisecond of the order before, and says nothing: neither a
# return value nor a log tells it. Guess: the newest order wins. A stop, all four channels 0, that comes right after an
# order to move is lost, and the drone moves on until something else is sent.
# Seen: of an order, a stop at once and a stop 0.1 s later, the drone receives the order and the later stop
set -euo pipefail
place=$(mktemp -d); trap 'rm -rf "$place"' EXIT
python3 -m venv "$place/venv"
"$place/venv/bin/pip" install --quiet djitellopy==2.5.0
cat > "$place/seen.py" <<'END'
import socket
import time

from djitellopy import Tello

drone = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
drone.bind(("127.0.0.1", 0))
drone.settimeout(1.0)
tello = Tello(host="127.0.0.1")
tello.address = drone.getsockname()
print("returned", *{tello.send_rc_control(0, 50, 0, 0), tello.send_rc_control(0, 0, 0, 0)})
time.sleep(0.1)
tello.send_rc_control(0, 0, 0, 0)
try:
    while True:
        print(drone.recv(100).decode())
except TimeoutError:
    pass
END
seen=$("$place/venv/bin/python" "$place/seen.py" 2>/dev/null)
printf '%s\n' "$seen"
[ "$seen" = "returned None
rc 0 50 0 0
rc 0 0 0 0" ] || { echo "the behaviour has changed" >&2; exit 1; }
