"""A simulator that is nobody's twin: plain zenoh and json, nothing of zenpark, as a stranger would write it.

python simulator.py ENDPOINT NAME:TAKES:X:Y:YAW ...   with TAKES one of position, velocity, twist
"""

import json
import math
import sys
import time

import zenoh

DT = 0.01


class Robot:
    def __init__(self, session, text):
        self.name, self.takes, *numbers = text.split(":")
        self.x, self.y, self.yaw = map(float, numbers)
        self.z, self.height, self.motors = 0.0, 0.0, False
        self.setpoint, self.heard, self.done = None, 0.0, 0
        key = f"park/{self.name}/"
        self.commands = session.declare_subscriber(key + "setpoint", zenoh.handlers.RingChannel(100))
        self.position = session.declare_publisher(key + "position", encoding="application/json")

    def obey(self, now):
        while (sample := self.commands.handler.try_recv()) is not None:
            order = json.loads(sample.payload.to_string())
            if order["seq"] <= self.done and order["action"] != "stop":
                continue  # said again, or overtaken
            self.done, action = max(self.done, order["seq"]), order["action"]
            if action == "drive":
                self.setpoint, self.heard = order["setpoint"], now
            elif action == "takeoff":
                self.motors, self.height, self.setpoint, self.heard = True, order["height"], None, 0.0
            elif action == "land":
                self.height, self.setpoint = 0.0, None
            else:
                self.motors, self.setpoint = False, None

    def move(self, now):
        if self.takes == "twist":
            v, w = self.setpoint[:2] if self.setpoint and now - self.heard < 0.5 else (0.0, 0.0)
            self.yaw += w * DT
            self.x, self.y = self.x + v * math.cos(self.yaw) * DT, self.y + v * math.sin(self.yaw) * DT
            return
        if not self.motors:
            self.z = max(0.0, self.z - 3.0 * DT)
            return
        if self.setpoint and now - self.heard > 0.5:  # nobody steers any more: hold, and after a while land
            self.setpoint = None if self.takes == "velocity" else self.setpoint
        if self.heard and now - self.heard > 3.0:
            self.height, self.setpoint = 0.0, None
        vx, vy, vz = 0.0, 0.0, max(-0.5, min(0.5, 3.0 * (self.height - self.z)))
        if self.setpoint and self.takes == "velocity":
            vx, vy, vz = self.setpoint[:3]
        elif self.setpoint:
            errors = (g - p for g, p in zip(self.setpoint, (self.x, self.y, self.z), strict=False))
            vx, vy, vz = (max(-1.0, min(1.0, 3.0 * e)) for e in errors)
        self.x, self.y, self.z = self.x + vx * DT, self.y + vy * DT, max(0.0, self.z + vz * DT)
        self.motors = self.z > 0.01 or self.height > 0.0

    def tell(self):
        place = {"robot": self.name, "stamp": time.time(), "position": [self.x, self.y, self.z], "yaw": self.yaw}
        self.position.put(json.dumps(place))


settings = zenoh.Config.from_json5(json.dumps({"mode": "client", "connect": {"endpoints": [sys.argv[1]]}}))
with zenoh.open(settings) as session:
    robots = [Robot(session, text) for text in sys.argv[2:]]
    print("ready", flush=True)
    due = time.monotonic()
    while not session.is_closed() and (due := due + DT):
        time.sleep(max(0.0, due - time.monotonic()))
        for robot in robots:
            robot.obey(time.monotonic())
            robot.move(time.monotonic())
            robot.tell()
