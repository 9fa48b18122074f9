"""zenpark beside other simulators: agent-steps per CPU second of the step loop alone, with ratios of the same minutes.

    python -m docs.bench.peers                      # those that are small to install, and bare Zenoh
    python -m docs.bench.peers vmas crazyflow       # these; VMAS needs torch (5.5 GB), crazyflow JAX (1.2 GB)
    python -m docs.bench.peers --all

Each simulator gets an environment of its own below `~/.cache/zenpark/peers` (remove its folder for newer versions) and
flies `docs/bench/drivers/ring.py`: the same ring, starts and law. All simulators fly one number of robots in turns,
each in a process that is warmed up; speeds are medians, ratios medians of the ratios of each turn.
"""

import argparse
import json
import os
import statistics
import subprocess
import sys
from collections import defaultdict
from contextlib import contextmanager
from dataclasses import dataclass
from operator import truediv
from pathlib import Path

from agents.user_folder import cache_folder
from docs.bench.drivers import peer_zenpark, ring
from experiments.file import document
from tests.bench.measuring import markdown
from tests.bench.process import FLIGHT_S, process

ROOT = Path(__file__).resolve().parents[2]
DRIVERS = "docs.bench.drivers"
ROBOTS = (7, 100, 1000)
ROUNDS = 3
MANY, SHORT_S = 500, 3.0  # robots from which on plain flights are shorter [s]: a second takes one of CPU
COMPILED_ROBOT_S = 2100.0  # robots × simulated time of a compiled flight [s]: ten seconds take milliseconds
INSTALL_S = 600.0
# threads of numpy gain nothing on arrays of this size, and would be charged
ONE_THREAD = dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"), "1")
# arguments of zenpark's driver: kind, engine, evaluator
WHEELS, COMPILED_WHEELS = "khepera4 point-mass plain", "khepera4 point-mass compiled"
DRONES, COMPILED_DRONES = "crazyflie point-mass plain", "crazyflie point-mass compiled"
RIGID = "crazyflie mujoco plain"
ZENOH = "zenoh"  # the bare network, in real time


class Failed(Exception):
    """A simulator that cannot be installed, or with a process that ended."""


@dataclass(frozen=True)
class Peer:
    """A simulator, or a setting of zenpark, which flies the ring."""

    bodies: str
    limit: str  # of its speed
    beside: tuple[str, ...] = ()  # settings of zenpark to compare it with
    packages: tuple[str, ...] = ()
    most: int = max(ROBOTS)  # robots that it takes
    heavy: bool = False  # installed by name alone


PEERS = {
    WHEELS: Peer("two wheels", "calls of Python: some 130 for an agent-step, none above a tenth of it"),
    COMPILED_WHEELS: Peer("two wheels", "tables of the poses sent and received; the ticks are a tenth", (WHEELS,)),
    DRONES: Peer("third order on each axis", "the same as plain wheels"),
    COMPILED_DRONES: Peer("third order on each axis", "the same as compiled wheels", (DRONES,)),
    RIGID: Peer("rigid, 1 kHz, firmware's cascade", "the cascade in numpy, ten times a step, and MuJoCo", most=100),
    "robotarium": Peer(
        "unicycles", "asks every pair of robots for a collision, in Python; takes 50 robots at most",
        (WHEELS, COMPILED_WHEELS), ("robotarium-python-simulator",), most=50,
    ),
    "irsim": Peer(
        "two wheels; collisions found and ignored",
        "each robot is a Python object; its shape is moved and entered into a tree",
        (WHEELS, COMPILED_WHEELS), ("ir-sim",),
    ),
    "gym-pybullet-drones": Peer("rigid, 240 Hz", "", (RIGID,), ("gym-pybullet-drones",)),
    "vmas": Peer(
        "point masses moved by forces; no collisions",
        "small torch operations for each robot; TorchRL's wrapper; made for thousands of worlds in a batch, has one",
        (WHEELS, COMPILED_WHEELS), ("vmas", "torchrl"), heavy=True,
    ),
    "crazyflow": Peer(
        "rigid, 500 Hz, model of the firmware's controller",
        "calls of JAX while robots are few; made for thousands of worlds in a batch, has one",
        (RIGID, DRONES, COMPILED_DRONES), ("crazyflow",), heavy=True,
    ),
}  # fmt: skip
OTHERS = [name for name, peer in PEERS.items() if peer.packages]


def duration_s(name, robots):
    """Simulated time of a flight of a setting of zenpark [s]."""
    if name in {COMPILED_WHEELS, COMPILED_DRONES}:
        return max(peer_zenpark.DURATION_S, COMPILED_ROBOT_S / robots)
    return SHORT_S if robots >= MANY else peer_zenpark.DURATION_S


@dataclass(frozen=True)
class Row:
    """A line of the table."""

    robots: int
    name: str
    version: str
    step_s: float
    speed: float  # agent-steps per CPU second
    ratios: dict[str, float]  # to settings of zenpark


def python_of(name):
    """Interpreter with a simulator, which is installed if it is not.

    Raises Failed with the first error of pip, or if it takes more than `INSTALL_S`.
    """
    folder = cache_folder() / "peers" / name
    python, packages = folder / "bin" / "python", PEERS[name].packages
    stamp, wanted = folder / "installed", " ".join(packages)
    if stamp.exists() and stamp.read_text("utf-8") == wanted:
        return python
    base = getattr(sys, "_base_executable", None) or sys.executable  # not our environment, which has other packages
    subprocess.run([base, "-m", "venv", "--clear", str(folder)], check=True)
    command = [python, "-m", "pip", "install", "--no-input", "--quiet", *packages]
    try:
        done = subprocess.run(
            command, check=False, timeout=INSTALL_S, capture_output=True, text=True, env=environment()
        )
    except subprocess.TimeoutExpired:
        raise Failed(f"{name} cannot be installed within {INSTALL_S:g} s") from None
    if done.returncode != 0:
        errors = (line for line in done.stderr.splitlines() if line.startswith("ERROR"))
        raise Failed(f"{name} cannot be installed: {next(errors, 'pip failed')}")
    stamp.write_text(wanted, encoding="utf-8")
    return python


def environment():
    """The user's environment without packages of elsewhere."""
    kept = {name: value for name, value in os.environ.items() if name not in {"PYTHONPATH", "PYTHONHOME"}}
    return {**kept, **ONE_THREAD}


def measured(name, robots, *arguments):
    """Measurement by a process of a simulator, after its warm-up; raises Failed if it ends with an error."""
    if PEERS[name].packages:
        command = [python_of(name), "-m", f"{DRIVERS}.peer_{name}", str(robots)]
    else:
        command = [sys.executable, "-m", f"{DRIVERS}.peer_zenpark", str(robots), *name.split(), *arguments]
    done = subprocess.run(command, cwd=ROOT, env=environment(), capture_output=True, text=True, check=False)
    if done.returncode != 0:
        said = done.stderr.strip().splitlines() or ["no message"]
        raise Failed(f"{name}, {robots} robots: {said[-1]}")
    return json.loads(
        [line for line in done.stdout.splitlines() if line.startswith("{")][-1]
    )  # libraries print as well


@contextmanager
def noting(troubles):
    """Add the failure of the block to `troubles`."""
    try:
        yield
    except Failed as why:
        troubles.append(str(why))


def measure(names, sizes, rounds, troubles):
    """Rows of some simulators and of the settings of zenpark beside them, by number of robots, but those that fail."""
    by_robots = defaultdict(list)
    for name in names:
        with noting(troubles):
            python_of(name)
            for robots in {min(size, PEERS[name].most) for size in sizes}:
                by_robots[robots].append(name)
    for robots, others in sorted(by_robots.items()):
        compared = {own for name in others for own in PEERS[name].beside}
        beside = [own for own in PEERS if own in compared and robots <= PEERS[own].most]
        speeds = {name: [] for name in [*beside, *others]}
        about = {}
        for turn in range(rounds):
            for name, taken in speeds.items():
                with noting(troubles):
                    if len(taken) == turn:
                        about[name] = found = measured(name, robots, f"{duration_s(name, robots):g}", "loop")
                        taken.append(found["agent_steps"] / found["cpu_s"])
        complete = {name: taken for name, taken in speeds.items() if len(taken) == rounds}
        for name, taken in complete.items():
            theirs = {other: complete[other] for other in PEERS[name].beside if other in complete}
            ratios = {other: statistics.median(map(truediv, taken, speed)) for other, speed in theirs.items()}
            version, step_s = about[name]["version"], about[name]["step_s"]
            yield Row(robots, name, version, step_s, statistics.median(taken), ratios)


def network():
    """Robot processes on the ring in real time, each beside a bare Zenoh process that exchanges the same poses.

    Medians of seven pairs of the same seconds; an agent-step is a pose that is sent.
    """
    robots = min(ROBOTS)
    read = document.loads(peer_zenpark.experiment(robots, *WHEELS.split()[:2], FLIGHT_S))
    bare, own = (figure for figure in process(read) if figure.name.startswith("CPU of a "))
    speed = peer_zenpark.HZ / (bare.value / 100.0)
    yield Row(robots, "robot process, real time", "", ring.STEP_S, speed / own.ratio, {})
    yield Row(robots, "bare Zenoh process", "", ring.STEP_S, speed, {"robot process, real time": own.ratio})


def title(name):
    """Name of a simulator, or of a setting of zenpark, for people."""
    return f"zenpark, {name}" if name in PEERS and name not in OTHERS else name


def table(rows):
    """Markdown."""
    lines = [["robots", "simulator", "step [ms]", "agent-steps per CPU second", "ratio"]]
    for row in rows:
        ratios = [f"{ratio:.2g} × {other}" for other, ratio in row.ratios.items() if other != row.name]
        speed = f"{float(f'{row.speed:.2g}'):,.0f}"
        name = f"{title(row.name)} {row.version}".strip()
        lines.append([f"{row.robots:,}", name, f"{1e3 * row.step_s:g}", speed, ", ".join(ratios)])
    return markdown(lines)


def report(names, sizes=ROBOTS, rounds=ROUNDS):
    """The rows, the bodies and limits of their simulators, and what could not be measured, in Markdown."""
    troubles = []
    rows = list(measure([name for name in names if name != ZENOH], sizes, rounds, troubles))
    found = {row.name for row in rows}
    limits = [[title(name), peer.bodies, peer.limit] for name, peer in PEERS.items() if name in found]
    if ZENOH in names:
        rows += network()
    parts = [table(rows), "\n".join(f"- {trouble}" for trouble in troubles)]
    if limits:
        parts.insert(1, markdown([["simulator", "bodies", "what limits it"], *limits]))
    return "\n\n".join(filter(None, parts))


def main():
    parser = argparse.ArgumentParser(prog="python -m docs.bench.peers", description=__doc__.splitlines()[0])
    parser.add_argument("names", nargs="*", metavar="NAME", help=f"of: {', '.join([*OTHERS, ZENOH])}")
    parser.add_argument("--all", action="store_true", help="the ones with large downloads as well")
    parser.add_argument("--robots", type=int, nargs="+", default=ROBOTS)
    parser.add_argument("--rounds", type=int, default=ROUNDS)
    wanted = parser.parse_args()
    if unknown := {*wanted.names} - {*OTHERS, ZENOH}:
        parser.error(f"unknown: {', '.join(sorted(unknown))}")
    names = wanted.names or [name for name in [*OTHERS, ZENOH] if name == ZENOH or wanted.all or not PEERS[name].heavy]
    print(report(names, wanted.robots, wanted.rounds))


if __name__ == "__main__":
    main()
