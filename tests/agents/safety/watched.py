"""A robot whose hazards are watched: each tick is put together by hand, without bodies or decisions."""

import math
from types import SimpleNamespace

from agents.body.interface import BodyState
from agents.body.limits import Limits
from agents.decision.neighbours import Incoming, Neighbours
from agents.decision.situation import ProcessHealth, Situation
from agents.kinds.crazyflie import CRAZYFLIE
from agents.plugins.predictors import HOLD
from agents.safety.detection import Detector, RobotStatus
from agents.safety.hazards import Cause, Hazards

DT = 0.01
NAN = math.nan


class Watched:
    """A robot that cruises at its place, with `neighbours` beside it, each a name and a kind."""

    def __init__(self, kind=CRAZYFLIE, neighbours=(), *, hover=0.5, avoids=False, **safety):
        limits = Limits(low=(-2.0, -2.0, 0.0), high=(2.0, 2.0, 2.5), **safety)
        incoming = [Incoming(number, name, of, 0.5) for number, (name, of) in enumerate(neighbours)]
        assignment = SimpleNamespace(
            name="A", kind=kind, hover=hover, limits=limits, predictor=HOLD, avoidance="potential", avoids=avoids
        )
        self.avoids = avoids
        self.detector, self.hazards = Detector(assignment), Hazards(kind, limits)
        self.neighbours, self.health = Neighbours(incoming, limits.neighbour_timeout_s), ProcessHealth()
        self.now, self.status = Situation(), RobotStatus()
        self.status.cruising, self.status.goal_height = True, hover
        self.position, self.velocity, self.yaw = (0.0, 0.0, hover), (0.0, 0.0, 0.0), 0.0
        self.values = {"battery": 0.8, "flying": kind.flies}
        self.active, self.landing = True, False
        self.t, self.causes = 1.0, 0
        self.acts = []
        for link in range(len(incoming)):
            self.neighbours.mark_alive(link)
            self.hear(link, (1.0, float(link), hover))

    def hear(self, link, position):
        """Receive a pose of a neighbour."""
        self.neighbours.receive(link, position, (0.0, 0.0, 0.0), self.t, self.t)

    def step(self, seconds=DT, every_tick=None):
        """Let time pass; `every_tick` may change what the next tick finds."""
        for _ in range(round(seconds / DT)):
            if every_tick is not None:
                every_tick(self)
            self.neighbours.update_active(self.t)
            given = {"time": self.t, "received": self.t, **self.values}
            state = BodyState(position=self.position, velocity=self.velocity, yaw=self.yaw, **given)
            self.now.state = state
            self.detector.sees = self.detector.sees or (self.avoids and state.scan is not None)
            self.now.begin(self.t)
            self.causes = self.detector.causes(self.now, self.status, self.neighbours, self.health)
            if self.causes or self.hazards.under_way:
                self.acts += self.hazards.update(
                    self.t, self.causes, self.words, active=self.active, landing=self.landing
                )
            self.t += DT
        return self

    def words(self, cause):
        if cause == Cause.BELOW:
            return "B; it goes aside first"
        return self.detector.words(cause, self.now, self.status, self.neighbours, self.health)

    def measure(self, *, flags=None, **values):
        """Let the body measure values from now on; `flags`: what is judged of its pose, as in `Situation`."""
        for name in ("position", "velocity", "yaw"):
            setattr(self, name, values.pop(name, getattr(self, name)))
        self.values |= values
        if flags is not None:
            self.now.sound = False
            for name, value in flags.items():
                setattr(self.now, name, value)
        return self

    @property
    def found(self):
        """Causes of the last tick."""
        return {cause for cause in Cause if self.causes >> cause & 1}

    @property
    def texts(self):
        return [incident.text for incident in self.hazards.incidents]
