#!/usr/bin/env bash
# cflib 0.1.34: the angles of a Lighthouse sweep arrive as one float and three halves that are taken from it. A half of
# minus zero, to which any difference between 0 and -3e-8 rounds, is decoded as the integer 2147483648, so that the angle
# of that sensor is two thousand million radians off. Guess: -0.0, as Python's struct decodes it.
# Seen: library 2147483648; struct -0.0; angles 0.125, -2147483647.875, 0.125, 0.125 where 0.125 was measured four times
set -euo pipefail
place=$(mktemp -d); trap 'rm -rf "$place"' EXIT
python3 -m venv "$place/venv"
"$place/venv/bin/pip" install --quiet cflib==0.1.34
cat > "$place/seen.py" <<'END'
import struct
from types import SimpleNamespace

from cflib.crazyflie.localization import Localization
from cflib.crtp.crtpstack import CRTPPacket, CRTPPort
from cflib.utils.encoding import fp16_to_float

half = struct.pack("<e", -1e-8)
print("library", fp16_to_float(*struct.unpack("<h", half)))
print("struct", *struct.unpack("<e", half))

packet = CRTPPacket()
packet.set_header(CRTPPort.LOCALIZATION, Localization.GENERIC_CH)
angles = struct.pack("<feee", 0.125, -1e-8, 0.0, 0.0)
packet.data = struct.pack("<BB", Localization.LH_ANGLE_STREAM, 0) + angles + angles
receiver = Localization(SimpleNamespace(add_port_callback=lambda port, receive: None))
receiver.receivedLocationPacket.add_callback(lambda received: print("angles", received.data["x"]))
receiver._incoming(packet)
END
seen=$("$place/venv/bin/python" "$place/seen.py")
printf '%s\n' "$seen"
[ "$seen" = "library 2147483648
struct -0.0
angles [0.125, -2147483647.875, 0.125, 0.125]" ] || { echo "the behaviour has changed" >&2; exit 1; }
