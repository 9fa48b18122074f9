"""Untested: Webots controller of a Khepera IV as a body `external` of zenpark."""

from __future__ import annotations

import importlib
import json
import math
import sys
import time

WHEEL_RADIUS = 0.021  # [m] radius of the Khepera IV's wheels
HALF_BASE = 0.0527  # [m]
PATIENCE_S = 0.5  # time without a new setpoint after which the wheels stop


def main(name: str, endpoint: str) -> None:
    """Run until Webots ends the controller; `name`: robot in the experiment, `endpoint`: its router."""
    zenoh = importlib.import_module("zenoh")
    robot = importlib.import_module("controller").Supervisor()
    step_ms = int(robot.getBasicTimeStep())
    wheels = [robot.getDevice(f"{side} wheel motor") for side in ("left", "right")]
    for wheel in wheels:
        wheel.setPosition(math.inf)  # Webots' way to ask for velocity control
        wheel.setVelocity(0.0)
    me = robot.getSelf()
    config = zenoh.Config.from_json5(json.dumps({"mode": "client", "connect": {"endpoints": [endpoint]}}))
    with zenoh.open(config) as session:
        commands = session.declare_subscriber(f"park/{name}/setpoint", zenoh.handlers.RingChannel(100))
        position = session.declare_publisher(f"park/{name}/position", encoding="application/json")
        v, turn, received, last_seq = 0.0, 0.0, 0.0, 0
        zero = time.time() - time.monotonic()  # read once: a step of the wall clock must not move a robot
        while robot.step(step_ms) != -1:
            while (sample := commands.handler.try_recv()) is not None:
                command = json.loads(sample.payload.to_string())
                if command["seq"] > last_seq or command["action"] == "stop":
                    last_seq, received = max(last_seq, command["seq"]), time.monotonic()
                    v, turn = command["setpoint"][:2] if command["action"] == "drive" else (0.0, 0.0)
            if time.monotonic() - received > PATIENCE_S:
                v = turn = 0.0
            for wheel, side in zip(wheels, (-1.0, 1.0), strict=True):
                wheel.setVelocity((v + side * HALF_BASE * turn) / WHEEL_RADIUS)
            rotation = me.getOrientation()  # nine numbers, row by row
            yaw = math.atan2(rotation[3], rotation[0])
            place = {"robot": name, "stamp": zero + time.monotonic(), "position": list(me.getPosition()), "yaw": yaw}
            position.put(json.dumps(place))


if __name__ == "__main__":
    main(sys.argv[1], sys.argv[2])
