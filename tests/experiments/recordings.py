"""Messages of a run of two robots, and recordings made of them."""

import resource
from contextlib import contextmanager

import msgspec
import numpy as np

from agents.network.messages import Contact, Event, ObstaclePose, Pose, PoseReceipt, State, Status, WorldState
from experiments.definition.experiment import Experiment, Formation, Rates, RobotTable
from experiments.definition.plan import Plan
from experiments.recording.playback import read
from experiments.recording.writer import Recording

START = 1_760_000_000.0
DOCUMENT = 'title = "pair"  # as it was written\n'
PAIR = Experiment(
    title="pair",
    robots={"TB01": RobotTable("turtlebot3", [0.0, 0.0]), "CF01": RobotTable("crazyflie", [1.0, 0.0], hover=0.8)},
    duration_s=1.0,
    formation=Formation(links={"TB01 - CF01": 1.0}),
    rates=Rates(state_hz=10.0),
)

# payloads may hold numbers that are not finite
PACKED = msgspec.structs.replace(PAIR, network=msgspec.structs.replace(PAIR.network, encoding="msgpack"))


def state(robot="TB01", seq=1, at=0.0, x=0.0, **more):
    known = {
        "phase": "run", "position": (x, 0.0, 0.0), "velocity": (0.1, 0.2, 0.3), "yaw": 0.0,
        "goal": (x + 1.0, 2.0, 3.0), "setpoint": (x, 0.0, 0.5, 0.25), "error": 0.05,
    }  # fmt: skip
    return State(robot, seq, START + at, **known | more)


def pose(robot="TB01", seq=1, at=0.0, x=0.0):
    return Pose(robot, seq, START + at, (x, 0.5, 0.0), (0.1, 0.2, 0.3), 0.4)


def status(robot="TB01", at=1.0, **more):
    return Status(robot, START + at, "run", "", **{"started": START, "pid": 7, "rss_mb": 1.0} | more)


def begun(at=0.0):
    return Event(START + at, "start", "conductor", "go")


def landed(at=1.0, text="landing"):
    return Event(START + at, "phase", "conductor", text)


def write(path, *messages, experiment=PAIR, **more):
    """Record messages as they come; a pose is received 2 ms after its stamp."""
    with recording(path, experiment, **more) as made:
        put(made, messages)
        return made


def trace_of(path, *messages, **more):
    """The trace of a recording of these messages."""
    write(path, *messages, **more)
    return read(path).trace


def recording(path, experiment=PAIR, document=DOCUMENT, **more):
    return Recording(path, Plan(experiment), document, **{"case": "only", "seed": 4, "clock": "real"} | more)


def put(recording, messages):
    for message in messages:
        recording.write(message, logged=message.stamp + 0.002 if isinstance(message, Pose) else None)


def touched(at, first="TB01", second="CF01"):
    return Contact(START + at, first, second, 0.25, 0.001)


def world_state(at, engine="pymunk"):
    obstacles = [ObstaclePose("box", (1.0, 0.5 * at, 0.1)), ObstaclePose("post", (0.0, 0.0, 0.0))]
    return WorldState(
        START + at, engine, at + 3.0, 0.98, 0.4, False, ["TB01"], ["CF01"], obstacles, 2, 0, 1, "none"
    )  # fmt: skip


def whole_run():
    """One second of two robots, the leader along x at 1 m/s."""
    messages = [begun(), status("TB01", at=0.0), status("CF01", at=0.0)]
    for k in range(11):
        at = k / 10
        receipt = PoseReceipt("TB01", k, START + at - 0.05, START + at - 0.04, (at - 0.05, 0.0, 0.0), (1.0, 0.0, 0.0))
        messages += [
            state("TB01", k + 1, at, at, true_position=(at, 0.0, 0.01), true_yaw=0.1),
            state("CF01", k + 1, at, -at, received=[receipt] if k else []),
            pose("TB01", k + 1, at, at),
        ]
    return [
        *messages,
        status("TB01", sent=11, ticks=100, missed=3, decisions=10),
        status("CF01", sent=0, ticks=99, decisions=9, lost={"TB01": 1}),
    ]


def seconds(count, phase="running"):
    """States of two robots at 10 Hz."""
    return [state(name, k, k / 10, phase=phase) for k in range(count) for name in ("TB01", "CF01")]


def scattered(count):
    """States that do not compress."""
    x = np.random.default_rng(1).normal(size=(count, 3)).tolist()
    return [state(seq=k + 1, at=k / count, position=tuple(p), goal=tuple(p)) for k, p in enumerate(x)]


def broken(path, *messages):
    """Recording without its last byte: its recorder was killed."""
    write(path, *(messages or whole_run()))
    path.write_bytes(path.read_bytes()[:-1])
    return path


def pair_with(**parts):
    """The pair of this module with other parts."""
    return msgspec.structs.replace(PAIR, **parts)


@contextmanager
def small_disk(size=40_000):
    """Files of this process may not grow beyond a size [bytes]."""
    limits = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (size, limits[1]))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, limits)
