"""A process that is started again with a clock that is behind is obeyed: its numbers count anew."""

from __future__ import annotations

from agents.network import messages
from agents.network.keys import Keys
from agents.robot import Robot
from agents.runtime.goal_inbox import GoalInbox
from experiments.definition.plan import Plan
from tests.experiments.real_time.processes.joined import KEYS, joined_world
from tests.fuzz.messages import sent
from tests.network import Net
from tests.small import pair

UTC = 1.7e9
NOW, BEHIND = 1_700_000_000_000, 1_600_000_000_000  # milliseconds, at which numbers begin


def own(net: Net, alive: str, session: str, *, gone: bool = False) -> None:
    net.deliver(f"{Keys.life(alive, session)}\0\0".encode(), gone=gone)


def test_world_obeys_sender_with_clock_behind():
    with Net().worn() as net:
        process = joined_world(net)

        def order(seq: int, action: str, **more: object) -> bool:
            """Whether it is carried out."""
            before = process.commands.done.get("F", 0)
            net.deliver(sent(KEYS.setpoint("F"), messages.Command("F", seq, UTC, action, **more))[0])
            process.commands.receive(0.0)
            return process.commands.done.get("F", 0) != before

        own(net, KEYS.alive("F"), "one")
        assert order(NOW, "takeoff", height=0.5)
        assert not order(BEHIND, "stop")  # of the same process: said again, or overtaken
        own(net, KEYS.alive("F"), "one")  # it was cut off, and is the same
        assert not order(BEHIND, "stop")
        own(net, KEYS.alive("F"), "one", gone=True)
        own(net, KEYS.alive("F"), "two")
        assert order(BEHIND, "stop")


def test_world_of_many_robots_knows_name_owners():
    names = [f"F{row:03}" for row in range(120)]  # each with a token, a claim and the token of an owner
    with Net().worn() as net:
        process = joined_world(net, name="F000")
        for alive in map(KEYS.alive, names):
            for token in (alive, Keys.life(alive, "one"), Keys.claim(alive, Keys.rank(1.0, "one"))):
                net.deliver(f"{token}\0\0".encode())
        process.commands.receive(0.0)
    assert process.commands.lives == dict.fromkeys(names, "one")


def test_centre_with_clock_behind_is_followed():
    robot = Robot(Plan(pair(architecture="centralised")).assignment("A"))
    with Net().worn() as net:
        goals = GoalInbox(net.session, KEYS, [robot], valid_box=(5.0, 5.0, 5.0))

        def tell(seq: int, t: float, x: float) -> float:
            """The goal that is pursued."""
            goal = messages.Goal("A", seq, UTC + t, (x, 0.0, 0.0), None, UTC + t)
            net.deliver(sent(KEYS.goal("A"), goal)[0])
            goals.receive(t, UTC)
            return robot.guidance.goal[0]

        own(net, KEYS.centre_alive, "one")
        assert tell(NOW, 1.0, 0.1) == 0.1
        assert tell(BEHIND, 1.1, 0.2) == 0.1
        assert goals.malformed == 1
        own(net, KEYS.centre_alive, "two")
        assert tell(BEHIND, 0.9, 0.3) == 0.3  # its clock lags by a little
        assert goals.malformed == 1


def test_late_goal_revives_no_dead_centre():
    guidance = Robot(Plan(pair(architecture="centralised")).assignment("A")).guidance
    goal = (0.0, 0.0, 0.0)
    guidance.receive(goal, 0.0, 1.0)
    guidance.mark_lost(2.0)
    guidance.receive(goal, 0.0, 1.9)
    assert guidance.unguided(2.1)
    guidance.receive(goal, 0.0, 2.2)  # of another one, such as a tool of ROS
    assert not guidance.unguided(2.3)
