"""Untested: robots with differential drive in Gazebo (gz-transport 13) as bodies `external` of zenpark."""

from __future__ import annotations

import importlib
import json
import math
import sys
import time
from collections.abc import Sequence
from typing import Any

PATIENCE_S = 0.5  # time without a new setpoint after which a robot stops


def heading(q: Any) -> float:  # noqa: ANN401 - a gz.msgs.Quaternion
    """Yaw [rad] of a quaternion."""
    return math.atan2(2.0 * (q.w * q.z + q.x * q.y), 1.0 - 2.0 * (q.y * q.y + q.z * q.z))


def main(endpoint: str, world: str, names: Sequence[str]) -> None:
    """Run until interrupted; `names`: models in Gazebo and robots in the experiment."""
    zenoh = importlib.import_module("zenoh")
    node = importlib.import_module("gz.transport13").Node()
    twist_type = importlib.import_module("gz.msgs10.twist_pb2").Twist
    poses_type = importlib.import_module("gz.msgs10.pose_v_pb2").Pose_V
    drives = {name: node.advertise(f"/model/{name}/cmd_vel", twist_type) for name in names}
    config = zenoh.Config.from_json5(json.dumps({"mode": "client", "connect": {"endpoints": [endpoint]}}))
    with zenoh.open(config) as session:
        ring = zenoh.handlers.RingChannel
        commands = {name: session.declare_subscriber(f"park/{name}/setpoint", ring(100)) for name in names}
        positions = {
            name: session.declare_publisher(f"park/{name}/position", encoding="application/json") for name in names
        }

        zero = time.time() - time.monotonic()  # read once: a step of the wall clock must not move a robot

        def publish(message: Any) -> None:  # noqa: ANN401 - a gz.msgs.Pose_V
            stamp = zero + time.monotonic()  # not the header's stamp, which is simulation time
            for pose in message.pose:
                if pose.name in positions:
                    p = pose.position
                    place = {"robot": pose.name, "stamp": stamp, "position": [p.x, p.y, p.z]}
                    positions[pose.name].put(json.dumps({**place, "yaw": heading(pose.orientation)}))

        node.subscribe(poses_type, f"/world/{world}/dynamic_pose/info", publish)
        last_seq, received = dict.fromkeys(names, 0), dict.fromkeys(names, 0.0)
        while True:
            for name in names:
                twist = None
                while (sample := commands[name].handler.try_recv()) is not None:
                    command = json.loads(sample.payload.to_string())
                    if command["seq"] > last_seq[name] or command["action"] == "stop":
                        last_seq[name], received[name] = max(last_seq[name], command["seq"]), time.monotonic()
                        twist = command["setpoint"][:2] if command["action"] == "drive" else (0.0, 0.0)
                if twist is None and time.monotonic() - received[name] > PATIENCE_S:
                    twist = (0.0, 0.0)
                if twist is not None:
                    message = twist_type()
                    message.linear.x, message.angular.z = twist
                    drives[name].publish(message)
            time.sleep(0.01)


if __name__ == "__main__":
    main(sys.argv[1], sys.argv[2], sys.argv[3:])
