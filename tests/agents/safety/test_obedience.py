"""Obedience: robots of every kind that are told to move and do not, and robots that move and are not told to."""

import math

import numpy as np
import pytest

from agents.body.kinds import CRAZYFLIE, KHEPERA4, KINDS, TELLO, TURTLEBOT3
from agents.decision.lifecycle import DONE
from agents.safety.obedience import Obedience
from experiments.definition.experiment import Formation, Robot
from tests.agents.few import pair
from tests.agents.swarm import Swarm
from twins.models.differential import Differential

DT = 0.01
EVERY = list(KINDS.values())
WHEELS = [KHEPERA4, TURTLEBOT3]


class Row:
    """One robot: its setpoints, and where it is measured."""

    def __init__(self, kind):
        self.kind, self.obedience = kind, Obedience([kind])
        self.position, self.yaw, self.tick = np.zeros((1, 3)), np.zeros(1), 0

    def setpoint(self, speed):
        """A setpoint (1, 4) that tells it to move along x at `speed` [m/s]."""
        if self.kind.takes == "position":
            return np.array([[*(self.position[0] + [speed / self.kind.response, 0.0, 0.0]), 0.0]])
        return np.array([[speed, 0.0, 0.0, 0.0]])

    def go(self, seconds, *, told=0.0, told_turn=0.0, speed=0.0, turn=0.0, every=1, step=None):
        """Let time pass; measured every so many ticks, and in whole steps [m]."""
        true, heading = self.position.copy(), self.yaw.copy()
        for _ in range(round(seconds / DT)):
            true = true + DT * speed * np.array([[math.cos(heading[0]), math.sin(heading[0]), 0.0]])
            heading = heading + turn * DT
            if self.tick % every == 0:
                self.position = true if step is None else np.round(true / step) * step
                self.yaw = heading
            setpoint = self.setpoint(told)
            if self.kind.takes == "twist":
                setpoint[0, 1] = told_turn
            self.obedience.update(self.tick * DT, setpoint, self.position, self.yaw, np.ones(1, dtype=bool))
            self.tick += 1
        return bool(self.obedience.still[0]), bool(self.obedience.strays[0])


@pytest.mark.parametrize("kind", EVERY, ids=lambda kind: kind.name)
def test_a_robot_that_does_as_it_is_told_is_obedient(kind):
    for speed in (0.1 * kind.speed, 0.5 * kind.speed, kind.speed):
        row = Row(kind)
        assert row.go(1.0) == (False, False)
        for _ in range(10):
            assert row.go(1.0, told=speed, speed=speed) == (False, False)
        assert row.go(0.4, speed=speed) == (False, False)  # it takes some time to stop
        assert row.go(5.0) == (False, False)


@pytest.mark.parametrize("kind", EVERY, ids=lambda kind: kind.name)
def test_a_robot_that_stands_though_it_is_told_to_move_is_found(kind):
    row = Row(kind)
    assert row.go(1.5, told=kind.speed) == (False, False)
    assert row.go(2.0, told=kind.speed) == (True, False)
    assert row.go(1.5, told=kind.speed, speed=0.9 * kind.speed) == (False, False)  # it has begun


@pytest.mark.parametrize("kind", WHEELS, ids=lambda kind: kind.name)
def test_wheels_that_crawl_or_turn_in_vain_are_found(kind):
    assert Row(kind).go(8.0, told=0.2 * kind.speed) == (True, False)
    assert Row(kind).go(4.0, told_turn=1.5) == (True, False)
    assert Row(kind).go(4.0, told_turn=1.5, turn=1.5) == (False, False)
    wobbling = Row(kind)  # to and fro is no way
    for _ in range(40):
        assert wobbling.go(0.1, told_turn=1.5) == (False, False)
        assert wobbling.go(0.1, told_turn=-1.5) == (False, False)


@pytest.mark.parametrize("kind", EVERY, ids=lambda kind: kind.name)
def test_a_robot_near_its_goal_need_not_move(kind):
    assert Row(kind).go(60.0, told=0.05 * kind.speed) == (False, False)


@pytest.mark.parametrize("kind", EVERY, ids=lambda kind: kind.name)
def test_a_robot_that_moves_without_being_told_is_found(kind):
    row = Row(kind)
    assert row.go(2.0) == (False, False)
    assert row.go(4.0, speed=0.4 * kind.speed) == (False, True)
    assert row.go(15.0) == (False, False)
    row = Row(kind)
    assert row.go(3.0, told=0.5 * kind.speed, speed=-0.5 * kind.speed) == (False, True)  # the other way


@pytest.mark.parametrize("kind", WHEELS, ids=lambda kind: kind.name)
def test_wheels_that_run_away_slowly_or_spin_are_found(kind):
    assert Row(kind).go(5.0, speed=0.1) == (False, True)  # as a Khepera that has lost its link
    assert Row(kind).go(4.0, turn=1.0) == (False, True)
    assert Row(kind).go(4.0, turn=1.0, told_turn=1.0) == (False, False)


@pytest.mark.parametrize("kind", WHEELS, ids=lambda kind: kind.name)
def test_coarse_and_rare_positions_are_no_disobedience(kind):
    row = Row(kind)
    for _ in range(20):
        assert row.go(1.0, told=0.05, speed=0.05, every=4, step=0.01) == (False, False)


def test_a_robot_that_was_put_elsewhere_is_not_straying():
    row = Row(CRAZYFLIE)
    row.go(3.0)
    row.position = row.position + 3.0
    assert row.go(3.0) == (False, False)


def test_rows_that_nobody_watches_are_left_alone():
    obedience = Obedience([TELLO, KHEPERA4])
    for tick in range(1000):
        here = np.full((2, 3), 0.003 * tick)
        here[1] = np.nan
        obedience.update(tick * DT, np.zeros((2, 4)), here, np.zeros(2), np.zeros(2, dtype=bool))
        assert not (obedience.still | obedience.strays).any()


def test_a_run_reports_wheels_that_stand_and_halts_wheels_that_run_away():
    for speed, expected in ((0.0, "warn: it is told to move and does not"), (0.2, "land: it moves and is not told to")):
        command = Differential.command

        def stubborn(model, twist, command=command, speed=speed):
            own = twist.copy()
            own[0] = [speed, 0.0]
            command(model, own)

        with pytest.MonkeyPatch.context() as patch:
            patch.setattr(Differential, "command", stubborn)
            swarm = Swarm(pair()).running().run(8.0)
        texts = [each.text for each in swarm.agent("A").hazards.incidents if each.row == 0]
        assert any(text.startswith(expected) for text in texts), texts


def test_wheels_led_by_a_dead_position_halt():
    robots = {"A": Robot(kind="khepera4", start=[-0.4, 0.0])}
    swarm = Swarm(pair(robots=robots, formation=Formation())).running().run(1.0)
    assert swarm.agent("A").go(0, (1.2, 0.0), swarm.t) == ""
    noise, place = np.random.default_rng(1), swarm.row("A", "position").copy()

    def dead(t, state):
        state.position[0, :2] = place[:2] + 3e-4 * noise.standard_normal(2)
        state.velocity[0] = 0.0
        return state

    swarm.groups[0].spoil = dead
    swarm.run(20.0)
    assert swarm.phase("A") == DONE
    assert swarm.row("A", "truth")[0] < 1.0  # it stands in the room, not 3 m beyond its wall
