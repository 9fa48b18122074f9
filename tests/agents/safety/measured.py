"""A Crazyflie that flies by positions from outside, on a clock: its decision, and the vehicle of the protocol twin."""

from collections import deque
from math import hypot, isfinite, remainder, tau

import numpy as np

from agents.body.external_pose import External
from agents.body.interface import BodyState
from agents.decision.lifecycle import AIRBORNE, READY
from agents.robot import Robot
from bridges.crazyflie.twin.vehicle import Vehicle
from experiments.definition.experiment import RobotTable
from experiments.definition.plan import Plan
from tests.requests import request
from tests.small import small
from twins.device import Capture, Faults

DT = 0.01  # [s]
CLIMB, DESCENT, SHORTEST_S = 0.4, 0.22, 1.5  # of the bridge [m/s], [s]
CAPTURED = {"positioning": {"system": "external"}}


class Flown:
    """The drone F at the origin, and the motion capture that measures it, with faults."""

    def __init__(
        self, *, hover=0.6, sigma=0.0003, seed=1, yaw=0.0, start=(0.0, 0.0), delay_s=0.0, faults=None, **parts
    ):
        """`delay_s`: from the stamps of positions to their arrival; `faults`: those of `Faults`."""
        robot = RobotTable(
            kind="crazyflie",
            start=list(start),
            hover=hover,
            body="crazyflie-twin",
            position="external",
            device=CAPTURED,
        )
        self.robot = Robot(Plan(small({"F": robot}, **{"duration_s": 60.0, **parts})).assignment("F"))
        asked = request("crazyflie", ["crazyflie-twin"], start=[(0.0, 0.0)], yaw=yaw, external=True, device=CAPTURED)
        self.vehicle, self.external = Vehicle(asked, Faults(), 0), External()
        self.delay_s, self.faults, self.sigma = delay_s, Faults(**(faults or {})), sigma
        self.random = np.random.default_rng(seed)
        self.t, self.log, self._under_way = 0.0, [], deque()
        self._capture = Capture(self.random)

    def _measure(self):
        robot, vehicle = self.robot, self.vehicle
        if self.faults.occluded(self.t):
            return
        place = np.array([vehicle.place]) + self.sigma * self.random.standard_normal((1, 3))
        place, toward, turned = self._capture.measured(self.faults, self.t, place, np.array([vehicle.model.yaw]))
        self._under_way.append((self.t, tuple(place[0].tolist()), float(toward[0] + turned[0])))
        while self._under_way and self._under_way[0][0] <= self.t - self.delay_s + 1e-9:
            stamp, position, yaw = self._under_way.popleft()
            late = self.t - stamp > robot.assignment.limits.late_s  # as `MeasuredPositions` refuses it
            if not late and robot.believes(stamp, position):
                yaw = robot.believed_yaw(stamp, yaw)
                if self.external.update(stamp, position, yaw):
                    vehicle.locate(position, 0.01)
                    if isfinite(yaw):
                        vehicle.estimator.turn = remainder(yaw - vehicle.model.yaw, tau)

    def step(self):
        robot, vehicle, planner = self.robot, self.vehicle, self.vehicle.planner
        vehicle.advance(self.t)
        self._measure()
        flying = vehicle.model.flying
        state = BodyState(
            self.t, vehicle.estimate, vehicle.velocity, vehicle.yaw, battery=0.9, flying=flying, received=self.t
        )
        self.external.fill(state)
        robot.transmit(self.t, state)
        robot.act(self.t)
        pose = vehicle.pose
        if robot.stops:
            vehicle.supervisor.stop()
        if robot.takes_off:
            hover = robot.assignment.hover
            span = max(hover / CLIMB, SHORTEST_S)
            planner.climb(self.t, pose, height=hover, yaw=pose[3], span=span, landing=False)
        elif robot.lands:
            span = max((pose[2] + 0.1) / DESCENT, SHORTEST_S)
            planner.climb(self.t, pose, height=-0.1, yaw=pose[3], span=span, landing=True)
        elif isfinite(robot.setpoint[0]):
            still = np.zeros((4, 8))
            still[:, 0] = robot.setpoint
            planner.follow(self.t, [(10.0, still)])
        self.log.append((self.t, *map(float, vehicle.place), flying))
        self.t = round(self.t + DT, 9)

    def until(self, phase, most_s=20.0):
        end = self.t + most_s
        while self.robot.lifecycle.phase < phase and self.t < end:
            self.step()
        return self

    def run(self, seconds):
        end = self.t + seconds
        while self.t < end:
            self.step()
        return self

    def climb(self):
        self.until(READY)
        assert self.robot.lifecycle.takeoff() == ""
        return self

    def fly(self, seconds):
        """Climb, begin half a second later, and go on for some seconds."""
        self.climb().until(AIRBORNE)
        self.robot.start(self.t + 0.5)
        return self.run(seconds)

    @property
    def aside(self):
        return max(hypot(x, y) for _, x, y, _, _ in self.log)

    @property
    def highest(self):
        return max(z for _, _, _, z, _ in self.log)

    @property
    def incidents(self):
        return [each.text for each in self.robot.hazards.incidents]
