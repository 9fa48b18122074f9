"""Every registered device behind its twin, judged by the truth; yours, too. What must fail is put into the guide's."""

import math
import time
from contextlib import ExitStack, closing, contextmanager
from dataclasses import replace

import pytest

from agents.body.interface import BodyError, refuse
from agents.body.kinds import KINDS
from agents.plugins import registry
from tests.agents.plugins.test_plugins_outside import source_of
from tests.bridges.driver import Driver, constant
from tests.requests import request
from tests.twins.loopback import Served, reached
from tests.waiting import only_user_of

pytestmark = [pytest.mark.system, pytest.mark.usefixtures("runtime_folder")]

DEVICES = sorted(name.removesuffix("-twin") for name in registry.names(registry.DEVICES))
GUIDE = "guide"  # the rovers of docs/plugins.md
HEIGHT_M, STANDS_M = 0.5, 0.05
SILENT_S = 0.6  # gap in the link, during which the stop is ordered
MOVES = {"position": (0.3, 0.0, HEIGHT_M, 0.0), "velocity": (0.15, 0.0, 0.0, 0.3), "twist": (0.1, 0.2, 0.0, 0.0)}
# what stands in the guide, what the mutant has instead
MIRRORED = ('"yaw": robot.yaw', '"yaw": -robot.yaw')
THREEFOLD = ('"yaw": robot.yaw', '"yaw": 3.0 * robot.yaw')
STOPPED_ONCE = ("if robot.stopped:", "if False:")
ENDLESS = ("now - commanded > WATCHDOG_S", "False")


class Parts:
    """Kind, twin and body of a device."""

    def __init__(self, device, mutants=()):
        self.kind, self.alone_s, made = KINDS.get(device), 1.0, {}
        if device == GUIDE:
            source = source_of("Rovers") + source_of("RoverTwin")
            for old, new in mutants:
                assert source.count(old) == 1
                source = source.replace(old, new)
            exec(source, made)
            self.kind, self.twin, self.body = KINDS["khepera4"], made["RoverTwin"], made["Rovers"]
        else:
            self.alone_s = self.kind.alone_s
            self.twin, self.body = registry.load(registry.DEVICES, f"{device}-twin"), None

    @contextmanager
    def served(self, endpoint, **faults):
        """The twin, the class of its body, and what that is asked: its own position, where it has one."""
        asked = request(self.kind, "twin", endpoints=(endpoint,))
        with Served(self.twin, asked, **faults) as twin:
            asked = reached(asked, twin.addresses)
            body = self.body or registry.load(registry.BODIES, registry.body_name(asked.addresses[0]))
            try:
                refuse(body, asked)
            except BodyError:
                asked = replace(asked, external=(True,))
            yield twin, body, asked


def place_and_yaw(twin):
    position, yaw = twin.truth()
    return tuple(position[0].tolist()), float(yaw[0])


@contextmanager
def moving(device, endpoint, mutants, silent_for_s):
    """Kind, twin, driver of a robot that moves by commands, a drone in the air, until its link is silent."""
    parts = Parts(device, mutants)
    silent_from_s = 18.0 if parts.kind.flies else 7.0
    faults = {"silent_from_s": silent_from_s, "silent_for_s": silent_for_s}
    with ExitStack() as stack:
        stack.enter_context(only_user_of(device))
        twin, made, asked = stack.enter_context(parts.served(endpoint, **faults))
        body = stack.enter_context(closing(made(asked)))
        body.open()
        driver = Driver(body, truth=twin.truth if asked.external[0] else None)
        if parts.kind.flies:
            driver.run(1.0)  # a Tello takes off as soon as it answers
            body.takeoff([0], [HEIGHT_M])
            driver.run(8.0)
        driver.decide = constant(*MOVES[parts.kind.takes])
        driver.run(silent_from_s - (time.monotonic() - twin.zero))
        yield parts, twin, driver


def judge_way_and_stop(device, endpoint, *mutants):
    """The place that it tells, and a stop that is lost at first."""
    with moving(device, endpoint, mutants, SILENT_S) as (parts, twin, driver):
        place, yaw = place_and_yaw(twin)
        assert math.hypot(*place[:2]) > 0.1, driver.state.note
        assert driver.state.position[0] == pytest.approx(place, abs=STANDS_M)
        assert math.remainder(driver.state.yaw[0] - yaw, math.tau) == pytest.approx(0.0, abs=0.1)
        if parts.kind.takes == "twist":
            assert 0.3 < yaw < math.pi, "a turn to the left"
        driver.run(0.1)
        driver.body.stop([0])
        driver.decide = None
        driver.run(SILENT_S + 1.0)
        place, _ = place_and_yaw(twin)
        driver.run(2.0)
        assert place_and_yaw(twin)[0] == pytest.approx(place, abs=0.01), "it goes on after a stop"
        assert place[2] < STANDS_M


def judge_late_command(device, endpoint, *mutants):
    """A stop from another thread, in a tick that has decided on its command."""
    with moving(device, endpoint, mutants, 0.0) as (parts, twin, driver):
        driver.body.stop([0])
        driver.body.command([MOVES[parts.kind.takes]])
        driver.decide = None
        before, _ = place_and_yaw(twin)
        driver.run(1.0)
        after, _ = place_and_yaw(twin)
        assert after[2] < STANDS_M
        assert parts.kind.flies or math.dist(before, after) < 0.03


def judge_loss(device, endpoint, *mutants):
    """Its link is lost in motion."""
    with moving(device, endpoint, mutants, math.inf) as (parts, twin, driver):
        ends = math.isfinite(parts.alone_s)
        driver.run(parts.alone_s if ends else 3.0)
        before, _ = place_and_yaw(twin)
        driver.run(1.0)
        after, _ = place_and_yaw(twin)
        stands = math.dist(before, after) < 0.01 and after[2] < STANDS_M
        assert stands == ends, f"{before} and {after} 1 s later; see `alone_s` of its kind"


@pytest.mark.parametrize("device", [GUIDE, *DEVICES])
def test_every_device_tells_its_way_and_stops(device, router):
    judge_way_and_stop(device, router.endpoint)


@pytest.mark.parametrize("device", [GUIDE, *DEVICES])
def test_every_device_obeys_no_late_command(device, router):
    judge_late_command(device, router.endpoint)


@pytest.mark.parametrize("device", [GUIDE, *DEVICES])
def test_every_device_left_alone_ends_as_said(device, router):
    judge_loss(device, router.endpoint)


@pytest.mark.parametrize(
    ("judge", "mutants"),
    [
        (judge_way_and_stop, [MIRRORED]),
        (judge_way_and_stop, [THREEFOLD]),
        (judge_way_and_stop, [STOPPED_ONCE, ENDLESS]),
        (judge_late_command, [STOPPED_ONCE]),
        (judge_loss, [ENDLESS]),
    ],
)
def test_device_with_a_defect_is_found(judge, mutants, router):
    with pytest.raises(AssertionError):
        judge(GUIDE, router.endpoint, *mutants)
