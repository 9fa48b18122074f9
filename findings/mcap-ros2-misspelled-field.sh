#!/usr/bin/env bash
# mcap-ros2-support 0.6.0: a field that the message does not have is left out when it is written, and the one that was
# meant becomes 0; nothing is raised. Guess: a KeyError, as a missing definition gives. A recording whose heights were
# written as `height` instead of `z` has all drones on the floor, found when the flight is long over.
# Seen: z 3.0 when it is named z, 0.0 when it is named height
set -euo pipefail
place=$(mktemp -d); trap 'rm -rf "$place"' EXIT
python3 -m venv "$place/venv"
"$place/venv/bin/pip" install --quiet mcap-ros2-support==0.6.0 mcap==1.6.0
cat > "$place/seen.py" <<'END'
import io

from mcap_ros2.reader import read_ros2_messages
from mcap_ros2.writer import Writer

file = io.BytesIO()
writer = Writer(file)
point = writer.register_msgdef("geometry_msgs/msg/Point", "float64 x\nfloat64 y\nfloat64 z\n")
for name in ("z", "height"):
    writer.write_message(f"/{name}", point, {"x": 1.0, "y": 2.0, name: 3.0})
writer.finish()
for message in read_ros2_messages(io.BytesIO(file.getvalue())):
    print(message.channel.topic, message.ros_msg.x, message.ros_msg.y, message.ros_msg.z)
END
seen=$("$place/venv/bin/python" "$place/seen.py")
printf '%s\n' "$seen"
[ "$seen" = "/z 1.0 2.0 3.0
/height 1.0 2.0 0.0" ] || { echo "the behaviour has changed" >&2; exit 1; }
