"""`./zenpark test --bench process`: CPU and memory of a robot process, beside a bare one with the same messages.

Each robot of the reference experiment has a bare process of its own name, which sends as many poses and receives those
of the same neighbours, in the same seconds through the same router. The ratio of the CPU times of each pair holds on a
busy machine as well; it is taken for each pose sent, because a robot that misses ticks sends fewer.
"""

import statistics
import tempfile
import time
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Final

from agents.network import messages
from agents.network.endpoints import free_endpoint
from experiments.file.document import Document, load
from experiments.real_time.conductor.case_processes import CaseContext
from experiments.real_time.conductor.conductor import Conductor
from experiments.real_time.conductor.run_view import Progress
from experiments.real_time.hosts.hosts import Hosts
from experiments.real_time.hosts.launcher import ROUTER, Launcher, Router
from experiments.recording.run_folder import SOURCE
from tests.bench.measuring import Figure
from tests.reliability.soak import Usage, usage_of

FLIGHT_S: Final = 20.0


class Meter:
    """Measures processes, by the names of their robots, from the first measurement to the last."""

    def __init__(self) -> None:
        self.first: dict[str, tuple[float, Usage]] = {}  # with its time [s, monotonic]
        self.last: dict[str, tuple[float, Usage]] = {}
        self.pss_mb: dict[str, float] = {}  # memory, of shared pages a part (proportional set size)

    def measure(self, pids: Mapping[str, int]) -> None:
        """Measure now; processes that have ended are left out."""
        for name, pid in pids.items():
            if (usage := usage_of(pid)) is not None:
                self.last[name] = time.monotonic(), usage
                self.first.setdefault(name, self.last[name])

    def weigh(self, pids: Mapping[str, int]) -> None:
        """Measure the memory, once: that takes milliseconds."""
        for name, pid in pids.items():
            lines = Path(f"/proc/{pid}/smaps_rollup").read_text("ascii").splitlines()
            self.pss_mb[name] = sum(int(line.split()[1]) for line in lines if line.startswith("Pss:")) * 1.024e-3

    def shares(self) -> dict[str, float]:
        """CPU time of each process over wall time [%]."""
        pairs = ((name, *self.first[name], *last) for name, last in self.last.items())
        return {name: 100.0 * (b.cpu_s - a.cpu_s) / (end - begin) for name, begin, a, end, b in pairs if end > begin}


def process(read: Document | None = None) -> Iterator[Figure]:
    """Robot processes in flight, in real time, each beside a bare process: CPU and memory of both.

    Args:
        read: Its first case is flown, with periodic poses and for `FLIGHT_S`; None: the reference experiment, with
            poses at 50 Hz and no plan of the leader.
    """
    read = read or load("robotic-park", f"duration_s={FLIGHT_S}", "timeline=[]", "trigger.period_s=0.02")
    case, plan = next(iter(read.cases().items()))
    experiment = plan.experiment
    robots, bare = Meter(), Meter()
    first, last = dict[str, messages.Status](), dict[str, messages.Status]()
    beside: dict[str, int] = {}

    def look(progress: Progress) -> None:
        statuses = {name: view.status for name, view in progress.robots.items()}
        running = {name: status for name, status in statuses.items() if status and status.phase == "running"}
        for name, status in running.items():
            first.setdefault(name, status)
            last[name] = status
        robots.measure({name: status.pid for name, status in running.items()})
        bare.measure({name: beside[name] for name in running})
        if not robots.pss_mb and len(running) == len(experiment.robots) and (progress.elapsed or 0.0) > FLIGHT_S / 2.0:
            robots.weigh({name: status.pid for name, status in running.items()})
            bare.weigh(beside)

    with tempfile.TemporaryDirectory() as name:
        folder, endpoints = Path(name), [free_endpoint()]
        with Launcher(folder / "logs") as launcher:
            launcher.preload()
            Router(ROUTER, endpoints).start(launcher)
            for robot in experiment.robots:
                senders = [link.name for link in plan.assignment(robot).neighbours]
                rate = f"{experiment.rates.pose_hz:g}"
                words = ("tests.bench.bare_process", endpoints[0], robot, rate, *senders)
                beside[robot] = launcher.start(f"bare-{robot}", *words).handle.pid
            source, hosts = folder / SOURCE, Hosts(launcher, endpoints)
            source.write_text(read.text, encoding="utf-8")
            context = CaseContext(plan, case, folder, source, endpoints, launcher, hosts)
            result = Conductor(context, look).run()
    assert result.ready_s is not None
    pose_hz, body_hz = experiment.rates.pose_hz, experiment.rates.body_hz
    ready, of_robots, of_bare = result.ready_s, robots.shares(), bare.shares()
    rates = {name: (last[name].sent - first[name].sent) / (last[name].stamp - first[name].stamp) for name in of_robots}
    ratio = statistics.median(of_robots[name] / rates[name] * pose_hz / of_bare[name] for name in rates)
    cpu_bare, cpu = (statistics.median(shares.values()) for shares in (of_bare, of_robots))
    memory, of_robot = (statistics.median(meter.pss_mb.values()) for meter in (bare, robots))
    missed = 100.0 * sum(s.missed for s in last.values()) / sum(s.ticks for s in last.values())
    robot = f"CPU of a robot ({pose_hz:g} Hz pose, {body_hz:g} Hz body)"
    for figure in (
        (f"{len(experiment.robots)} robots ready after", ready, "s", ready / 3.0, "× 3 s"),
        (f"CPU of a bare process ({pose_hz:g} Hz pose)", cpu_bare, "% of a core", 1.0, "yardstick"),
        (robot, cpu, "% of a core", ratio, "× bare process, each pose"),
        ("memory of a bare process (PSS)", memory, "MB", 1.0, "yardstick"),
        ("memory of a robot (PSS)", of_robot, "MB", of_robot / memory, "× bare process"),
        ("missed deadlines", missed, "%", missed, "× 1 %"),
    ):
        yield Figure("process", *figure)
