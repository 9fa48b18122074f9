"""zenpark in virtual time: the agents with all their safety, their messages on the modelled network, and the bodies.

python -m docs.bench.drivers.peer_zenpark ROBOTS KIND ENGINE plain|compiled SECONDS loop|all
"""

import math
import resource
import sys
import time

from docs.bench.drivers import ring
from experiments.file import document
from experiments.metrics import measure as metrics
from experiments.virtual_time import stretch
from experiments.virtual_time.log import RunRecorder
from experiments.virtual_time.simulation import VirtualRun

HZ = round(1.0 / ring.STEP_S)
HOVER = {"crazyflie": ", hover = 0.8"}  # [m]
DURATION_S = 10.0
FORMED_S = 10.0  # after which links are within their tolerance


def experiment(robots, kind, engine, duration_s):
    """Text of the experiment: poses, law and bodies at one rate, no noise, telemetry at a fifth of the rate."""
    place, begin = ring.places(robots), ring.starts(robots)
    names = [f"R{number:05d}" for number in range(robots)]
    size = math.ceil(2.0 * abs(place).max() + 4.0)
    heads = {
        "rates": f"body_hz = {HZ}\npose_hz = {HZ}\ncoordination_hz = {HZ}\nstate_hz = 10",
        "arena": f"size = [{size}, {size}, 2.5]",
        "world": f'engine = "{engine}"',
        "formation": f'law = "displacement"\nstiffness = {ring.CLOSER[kind]}\nclamp = {ring.LARGEST}',
    }
    lines = ['title = "ring"', f"duration_s = {duration_s:g}"]
    lines.append(f'trigger = {{ kind = "periodic", period_s = {ring.STEP_S} }}')
    lines += [f"[{head}]\n{settings}" for head, settings in heads.items()]
    lines.append("[robots]")
    for name, (x, y) in zip(names, begin, strict=True):
        lines.append(f'{name} = {{ kind = "{kind}", start = [{x:.4f}, {y:.4f}]{HOVER.get(kind, "")} }}')
    lines.append("[formation.links]")
    for one, name in enumerate(names):
        other = (one + 1) % robots
        x, y = place[other] - place[one]
        lines.append(f'"{name} - {names[other]}" = {{ offset = [{x:.4f}, {y:.4f}] }}')
    return "\n".join(lines)


def measure(robots, kind, engine, evaluator, duration_s, *, complete=False):
    """CPU time of parts of a run: reading, all up to the common start, the loop from there to the end, metrics.

    With the peak memory of this process.

    Args:
        evaluator: "plain" or "compiled".
        complete: Take metrics as well, and check that the ring formed.

    Raises:
        SystemExit: If it did not, or if nothing was compiled.
    """
    stretch.WORK[:] = [{"plain": -math.inf, "compiled": math.inf}[evaluator]] * 2
    begun = time.process_time()
    read = document.loads(experiment(robots, kind, engine, duration_s))
    loaded = time.process_time()
    ((case, flown),) = read.cases().items()
    flight = VirtualRun(flown, seed=1, quiet=True, lean=False)
    moment = flight.begin()
    start = time.process_time()
    flight.decide(moment)
    flight.fly(landing=False, progress=lambda _: None)
    end = time.process_time()
    ticks = round(duration_s * HZ)
    found = {"cpu_s": end - start, "agent_steps": ticks * robots, "read_s": loaded - begun, "start_s": start - loaded}
    if evaluator == "compiled" and (flight.stretches is None or flight.stretches.flown < 0.9 * ticks):
        raise SystemExit(f"not compiled: {stretch.REFUSED}")
    if complete:
        measured = metrics.measure(RunRecorder(flight.log(), flown, case).trace())
        found["metrics_s"] = time.process_time() - end
        if duration_s >= FORMED_S and any(robot.acquired_s is None for robot in measured.robots):
            raise SystemExit("the ring does not form")
    return {**found, "memory_mb": resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024.0}


if __name__ == "__main__":
    robots, *setting, duration_s, what = sys.argv[1:]
    measure(7, *setting, DURATION_S, complete=True)  # warm-up
    ring.answer(measure(int(robots), *setting, float(duration_s), complete=what == "all"), "", ring.STEP_S)
