"""Good messages of every kind, in both encodings, for the mutator to spoil."""

import time

from agents.network import messages
from agents.network.keys import Keys

KEYS = Keys()


def good(robot, seq=1, ahead=0.0):
    """By the name of its key what a robot says, with stamps so far ahead of now [s]."""
    now = time.time() + ahead
    place, rest = (-0.5, -0.4, 0.0), (0.0, 0.0, 0.0)
    heard = messages.PoseReceipt("KH02", seq, now, now, place, rest)
    status = messages.Status(
        robot=robot, stamp=now, phase="running", reason="", body="", battery=0.5, sent=seq, received=2,
        lost={"KH01": 1}, dropped={"KH02": 1}, malformed=0, refused=0, ticks=5, missed=1,
        decisions=2, interventions=0, avoided=0, late_s=0.001, started=now - 1.0, missing=["KH02"],
        pid=1, cpu_s=0.1, rss_mb=60.0, hazard="hold: ordered to hold",
        incidents=[messages.Incident(seq, now, "hold: ordered to hold")],
    )  # fmt: skip
    commands = [
        messages.Command(robot, seq + 10, now, "drive", (0.1, 0.2, 0.0, 0.0)),
        messages.Command(robot, seq + 20, now, "takeoff", height=0.5),
        messages.Command(robot, seq + 30, now, "land"),
        messages.Command(robot, seq + 40, now, "stop"),
    ]
    return {
        "pose": [messages.Pose(robot, seq + k, now + 0.01 * k, place, rest, 0.1) for k in range(2)],
        "state": [
            messages.State(robot, seq, now, "running", place, rest, 0.1, place, (0.1, 0.2, 0.0, 0.0), 0.1, place,
            0.1, [heard], goal_receipts=[messages.GoalReceipt(seq, now, now, now)]),
            messages.State(robot, seq, now, "idle", place, rest, 0.1, None, None, 0.1, attitude=(1.0, 0.0, 0.0, 0.0)),
        ],
        "status": [status],
        "position": [messages.Position(robot, now, place, 0.1), messages.Position(robot, now, place)],
        "truth": [messages.Position(robot, now, place, 0.1)],
        "setpoint": list(commands),
        "ranges": [messages.Ranges(robot, now, [0.0, 0.1], [0.0, 0.0], [1.0, None])],
        "order": [
            messages.Order("takeoff"), messages.Order("start", at=now + 0.5), messages.Order("hold"),
            messages.Order("resume"),
            messages.Order("leave"), messages.Order("land"),
            messages.Order("stop"), messages.Order("get", name="clamp"), messages.Order("set", name="clamp", value=0.2),
            messages.Order("set", name="trigger.period_s", value=0.05),
        ],
        "goal": [
            messages.Goal(robot, seq + k, now, place, 0.1 if k else None, now - 0.01, [0.1, 0.0] if k else None)
            for k in range(2)
        ],
    }  # fmt: skip


def of_all():
    """By key what is nobody's."""
    now = time.time()
    world = messages.WorldState(
        now, "pymunk", 1.0, 1.0, 0.1, False, ["KH01"], ["CF01"],
        [messages.ObstaclePose("box", (0.1, 0.2, 0.3))], 1, 0, 0, "",
    )  # fmt: skip
    centre = messages.CentreState(
        stamp=now, robots=["KH01"], missing=["KH02"], load=0.1, late_s=0.001, decisions=5, missed=1, goals=5,
        received={"KH01": 2}, lost={"KH01": 1}, dropped={"KH01": 0}, malformed=0, pid=1, cpu_s=0.1, rss_mb=60.0,
    )  # fmt: skip
    orders = [
        messages.WorldOrder("pause"), messages.WorldOrder("resume"),
        messages.WorldOrder("reset"), messages.WorldOrder("reset", name="KH01"),
    ]  # fmt: skip
    return {
        KEYS.estop: [messages.Stop("a test", "to see")],
        KEYS.event: [messages.Event(now, "phase", "conductor", "landing")],
        KEYS.contact: [messages.Contact(now, "KH01", "wall", 0.1, 0.001)],
        KEYS.world: [world],
        KEYS.centre: [centre],
        KEYS.clock: [messages.HostClock("lab1", now, 0.2, 0.001, ["KH01"], 0.2)],
        KEYS.world_order: list(orders),
        KEYS.run_order: [
            messages.RunOrder("remove", ["KH01"], operator="ana"),
            messages.RunOrder("remove", ["KH01", "KH02"]),
            messages.RunOrder("restart", ["CF01"]),
            messages.RunOrder("add", ["nobody"]),
            messages.RunOrder("replace", ["KH01"], spare="S1"),
            messages.RunOrder("replace", ["KH01"], body="twin", at=(0.1, 0.2), yaw=1.0),
        ],
    }


def sent(key, message):
    """A message as `network.Net.deliver` takes it, in both encodings."""
    return [
        b"\0".join([key.encode(), messages.MIME[encoding].encode(), messages.encode(message, encoding)])
        for encoding in ("json", "msgpack")
    ]


def everything(*robots, only=()):
    """All messages of these robots, and those that are nobody's; or only those of some kinds."""
    found = []
    for number, robot in enumerate(robots):
        for what, said in good(robot, 1 + 100 * number).items():
            if not only or what in only:
                found += [part for message in said for part in sent(f"park/{robot}/{what}", message)]
        found.append(b"park/" + robot.encode() + b"/alive\0text/plain\0")
    many = {key: said[0] for what, said in good(robots[0], 900).items() for key in (f"park/*/{what}", "park/**", "**")}
    for key, message in many.items():  # whoever puts on a wildcard reaches everybody
        if not only or key.rpartition("/")[2] in (*only, "**"):
            found += sent(key, message)
    for key, said in of_all().items():
        if not only or key.rpartition("/")[2] in only:
            found += [part for message in said for part in sent(key, message)]
    return found
