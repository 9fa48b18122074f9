"""Good messages of every kind, in both encodings, for the mutator to spoil."""

import time

from agents.network import messages
from agents.network.keys import Keys

KEYS = Keys()
PLACE, REST = (-0.5, -0.4, 0.0), (0.0, 0.0, 0.0)


def good(robot, seq=1):
    """By the name of its key what a robot says."""
    now = time.time()
    status = messages.Status(
        robot, now, "running", "", battery=0.5, sent=seq, received=2, lost={"KH01": 1}, dropped={"KH02": 1}, ticks=5,
        started=now - 1.0, missing=["KH02"], pid=1, hazard="hold: ordered: by an operator",
        incidents=[messages.Incident(seq, now, "hold: ordered: by an operator")],
    )  # fmt: skip
    state = messages.State(
        robot, seq, now, "running", PLACE, REST, 0.1, PLACE, (0.1, 0.2, 0.0, 0.0), 0.1, PLACE, 0.1,
        [messages.PoseReceipt("KH02", seq, now, now, PLACE, REST)], attitude=(1.0, 0.0, 0.0, 0.0),
        goal_receipts=[messages.GoalReceipt(seq, now, now, now)],
    )  # fmt: skip
    command = messages.Command(robot, seq + 10, now, "drive", (0.1, 0.2, 0.0, 0.0))
    return {
        "pose": [messages.Pose(robot, seq + k, now + 0.01 * k, PLACE, REST, 0.1) for k in range(2)],
        "state": [state, messages.State(robot, seq, now, "idle", PLACE, REST, 0.1)],
        "status": [status],
        "position": [messages.Position(robot, now, PLACE, 0.1), messages.Position(robot, now, PLACE)],
        "truth": [messages.Position(robot, now, PLACE, 0.1)],
        "setpoint": [
            command,
            messages.Command(robot, seq + 20, now, "takeoff", height=0.5),
            *(messages.Command(robot, seq + 30, now, action) for action in ("land", "stop")),
        ],
        "ranges": [messages.Ranges(robot, now, [0.0, 0.1], [0.0, 0.0], [1.0, None])],
        "order": [
            *map(messages.Order, ("takeoff", "hold", "resume", "leave", "land", "stop")),
            messages.Order("start", at=now + 0.5),
            messages.Order("get", name="clamp"),
            messages.Order("set", name="trigger.period_s", value=0.05),
        ],
        "goal": [
            messages.Goal(robot, seq, now, PLACE, None, now - 0.01),
            messages.Goal(robot, seq + 1, now, PLACE, 0.1, now - 0.01, [0.1, 0.0]),
        ],
    }


def of_all():
    """By key what is nobody's."""
    now = time.time()
    box = messages.ObstaclePose("box", (0.1, 0.2, 0.3))
    changes = [("remove", "KH01"), ("restart", "CF01"), ("add", "nobody")]
    return {
        KEYS.estop: [messages.Stop("a test", "to see")],
        KEYS.event: [messages.Event(now, "phase", "conductor", "landing")],
        KEYS.world_event: [messages.Event(now, "contact", "world", "KH01 touches KH02 (0.1 N s)")],
        KEYS.contact: [messages.Contact(now, "KH01", "wall", 0.1, 0.001)],
        KEYS.world: [messages.WorldState(now, "pymunk", 1.0, 1.0, 0.1, False, ["KH01"], ["CF01"], [box])],
        KEYS.centre: [messages.CentreState(now, ["KH01"], ["KH02"], received={"KH01": 2}, lost={"KH01": 1})],
        KEYS.clock: [messages.HostClock("lab1", now, 0.2, 0.001, ["KH01"], 0.2)],
        KEYS.world_order: [*map(messages.WorldOrder, ("pause", "resume")), messages.WorldOrder("reset", name="KH01")],
        KEYS.run_order: [
            *(messages.RunOrder(order, [robot], operator="ana") for order, robot in changes),
            messages.RunOrder("replace", ["KH01"], spare="S1"),
            messages.RunOrder("replace", ["KH01"], body="twin", at=(0.1, 0.2), yaw=1.0),
        ],
    }


def sent(key, message):
    """A message as `network.Net.deliver` takes it, in both encodings."""
    heads = {encoding: f"{key}\0{messages.MIME[encoding]}\0".encode() for encoding in ("json", "msgpack")}
    return [head + messages.encode(message, encoding) for encoding, head in heads.items()]


def everything(*robots, only=()):
    """All messages of these robots, and those that are nobody's; or only those of some kinds."""
    said = of_all()
    for what, (first, *_) in good(robots[0], 900).items():  # a message on a wildcard reaches all keys
        said |= {f"park/*/{what}": [first], "park/**": [first], "**": [first]}
    for number, robot in enumerate(robots):
        said |= {f"park/{robot}/{what}": several for what, several in good(robot, 1 + 100 * number).items()}
    found = [f"park/{robot}/alive\0text/plain\0".encode() for robot in robots]
    for key, several in said.items():
        if not only or key.rpartition("/")[2] in (*only, "**"):
            found += [part for message in several for part in sent(key, message)]
    return found
