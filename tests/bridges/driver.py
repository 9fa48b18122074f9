"""A body driven as a robot's process drives it: located, read and commanded every 10 ms."""

import threading
import time
from math import nan

import numpy as np

from agents.decision.position_control import PositionController
from agents.vectors import NO_SETPOINT
from tests.waiting import PATIENCE_S

NUMBERS = ("time", "position", "velocity", "yaw", "true_position", "true_yaw", "battery", "flying", "received")


class Columns:
    """States of several robots side by side: arrays of numbers, and tuples `note`, `refusal`, `scan`."""

    def __init__(self, states):
        for name in NUMBERS:
            setattr(self, name, np.array([getattr(state, name) for state in states]))
        for name in ("note", "refusal", "scan"):
            setattr(self, name, tuple(getattr(state, name) for state in states))


class Driver:
    """Reads an open body, and gives it the setpoints that `decide` makes of the states; None: no setpoints.

    `truth` returns positions and yaws that are measured from outside; `clock` may be `fast` times as fast as time.
    """

    def __init__(self, body, decide=None, *, truth=None, clock=time.monotonic, fast=1.0):
        self.body, self.decide, self.truth = body, decide, truth
        self.zero, self.t = clock(), 0.0
        self.state = None
        self._clock, self._period = clock, 0.01 / fast
        self._pause = threading.Event()

    def tick(self):
        self._pause.wait(self._period)
        self.t = self._clock() - self.zero
        if self.truth is not None:
            for row, (position, yaw) in enumerate(zip(*self.truth(), strict=True)):
                self.body.locate(row, self.t, tuple(map(float, position)), float(yaw))
        states = self.body.read(self.t)
        self.state = Columns(states)
        self.body.command([NO_SETPOINT] * len(states) if self.decide is None else list(self.decide(states)))
        return self.state

    def until(self, true, what="it is true"):
        """Go on until something is true; returns how long that took [s]."""
        begin, deadline = self.t, time.monotonic() + PATIENCE_S
        self.tick()
        while not true():
            assert time.monotonic() < deadline, f"not in {PATIENCE_S:g} s: {what}; notes: {self.state.note}"
            self.tick()
        return self.t - begin

    def run(self, seconds):
        end = self.t + seconds
        while self.t < end:
            self.tick()
        return self.state


def toward(kind, goals, yaws=nan):
    """Position control (`Driver.decide`) toward goals (x, y, z) [m]; a robot whose goal is None is left alone."""
    law = PositionController(kind)
    yaws = np.broadcast_to(yaws, len(goals)).tolist()

    def decide(states):
        for goal, yaw, state in zip(goals, yaws, states, strict=True):
            yield NO_SETPOINT if goal is None else law.setpoint(goal, yaw, state.position, state.yaw)

    return decide


def constant(*setpoint):
    """The same setpoint (`Driver.decide`) for all robots."""
    padded = (*setpoint, *[0.0] * (4 - len(setpoint)))
    return lambda states: [padded] * len(states)
