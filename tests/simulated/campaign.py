"""Random scripts by the thousand; a seed that breaks a rule is shrunk to the few faults that do it.

python -m tests.simulated.campaign --seeds 1 200                  # seeds 1 to 200, over all experiments in turn
python -m tests.simulated.campaign --seeds 1 200 --of random --processes 2
python -m tests.simulated.campaign --one 17 -v                    # repeats seed 17, with all that was seen
python -m tests.simulated.campaign --one 17 --shrink              # the fewest faults that break the same rule
"""

from __future__ import annotations

import argparse
import itertools
import random
import sys
import time
from collections import Counter
from collections.abc import Iterable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace

from tests.simulated.experiments import FIXED, NAMES, RANDOM, setting_of
from tests.simulated.faults import Fault
from tests.simulated.laboratory import Flight, Nursery, Request, SimulatorError

SHRINK_S = 60.0  # of processor time
FEW = 3  # faults of a script that is short enough


def request_of(seed: int, name: str | None = None) -> Request:
    """The flight of a seed: its experiment, unless one is named, its script, lateness, and times of starts."""
    names = [*FIXED, RANDOM, RANDOM]
    setting = setting_of(name or names[seed % len(names)], seed)
    rng = random.Random(f"request {seed}")
    clock = rng.choice((0.03, -0.03, 0.4, -0.4, 2.0, -2.0, 4.5, -4.5, 20.0, -20.0))
    return Request(
        setting.experiment,
        seed=seed,
        case=setting.case,
        settings=setting.settings,
        preempt=rng.choice((0.0, 0.002, 0.03)),
        varied=rng.random() < 0.6,
        clocks={rng.choice(("KH01", "CF01", "A", "B")): clock} if rng.random() < 0.15 else {},
        drawn=seed,
    )


def broken(flight: Flight) -> set[str]:
    """Rules that a flight breaks."""
    return {each.rule for each in flight.violations}


def shrink(request: Request, flight: Flight, nursery: Nursery) -> tuple[list[Fault], Flight]:
    """The fewest faults found that break one of the same rules, within `SHRINK_S` of processor time."""
    rules, spent_s = broken(flight), 0.0
    script = list(flight.script)
    size = max(1, len(script) // 2)
    while spent_s < SHRINK_S:
        for start in range(0, len(script), size):
            fewer = script[:start] + script[start + size :]
            tried = nursery.run(replace(request, drawn=None, script=tuple(fewer)))
            spent_s += tried.cpu_s
            if broken(tried) & rules:
                script, flight = fewer, tried
                break
        else:
            if size == 1:
                break
            size = max(1, size // 2)
    return script, flight


def repeat(seed: int, name: str | None) -> str:
    """The command that repeats a flight."""
    return f"python -m tests.simulated.campaign --one {seed}{f' --of {name}' if name else ''} -v"


@dataclass
class Sum:
    """Figures of a campaign."""

    flights: int = 0
    faults: int = 0
    cpu_s: float = 0.0
    robot_s: float = 0.0

    def add(self, flight: Flight) -> None:
        self.flights += 1
        self.faults += len(flight.notes)
        self.cpu_s += flight.cpu_s
        self.robot_s += flight.robot_s

    def __str__(self) -> str:
        return (
            f"{self.flights} seeds, {self.faults} faults, {self.cpu_s:.0f} s of CPU: "
            f"{60.0 * self.faults / max(self.cpu_s, 1e-9):.0f} faults per CPU minute, "
            f"{self.robot_s / max(self.cpu_s, 1e-9):.0f} robot-s per CPU s"
        )


def fly(seeds: Iterable[int], name: str | None, nursery: Nursery) -> Iterator[tuple[int, Flight | SimulatorError]]:
    for seed in seeds:
        try:
            yield seed, nursery.run(request_of(seed, name))
        except SimulatorError as error:
            yield seed, error


def failure(seed: int, name: str | None, nursery: Nursery, flight: Flight | SimulatorError) -> str:
    """What a seed breaks, shrunk, and the command that repeats it; empty if all is well."""
    if isinstance(flight, SimulatorError):
        return f"seed {seed}: {flight}\n  {repeat(seed, name)}"
    if not flight.violations:
        return ""
    script, least = shrink(request_of(seed, name), flight, nursery)
    lines = [f"seed {seed}, exit code {flight.code}: {repeat(seed, name)}"]
    lines += [f"  {each.rule} at {each.t:.2f} s: {each.text}" for each in least.violations]
    return "\n".join([*lines, *(f"    {fault}" for fault in script)])


def campaign(seeds: Sequence[int], name: str | None, processes: int) -> int:
    """Fly seeds in some processes at a time, and print what they break; the exit code."""
    total, rules, codes, waiting = Sum(), Counter[str](), Counter[int | None](), iter(seeds)
    begun = time.monotonic()

    def work(_: int) -> None:
        nursery = Nursery()
        for seed in waiting:
            for _seed, flight in fly([seed], name, nursery):
                if isinstance(flight, Flight):
                    total.add(flight)
                    codes[flight.code] += 1
                    rules.update(broken(flight))
                else:
                    rules["simulator"] += 1
                if text := failure(seed, name, nursery, flight):
                    print(text, flush=True)
        nursery.close()

    with ThreadPoolExecutor(processes) as pool:
        list(pool.map(work, range(processes)))
    print(f"{total}; {time.monotonic() - begun:.0f} s", f"exit codes {dict(codes)}", f"broken {dict(rules)}", sep="\n")
    return int(bool(rules))


def main() -> int:
    parser = argparse.ArgumentParser(prog="python -m tests.simulated.campaign", description=__doc__)
    parser.add_argument("--seeds", nargs=2, type=int, metavar=("FIRST", "COUNT"))
    parser.add_argument("--one", type=int, metavar="SEED")
    parser.add_argument("--of", choices=NAMES, help="this experiment alone")
    parser.add_argument("--processes", type=int, default=1)
    parser.add_argument("--shrink", action="store_true")
    parser.add_argument("-v", action="store_true", help="all that was seen")
    given = parser.parse_args()
    if given.one is None:
        first, count = given.seeds or (1, 200)
        return campaign(list(itertools.islice(itertools.count(first), count)), given.of, given.processes)
    nursery = Nursery()
    flight = nursery.run(request_of(given.one, given.of))
    if given.shrink:
        print(failure(given.one, given.of, nursery, flight))
    if given.v:
        print(flight.describe())
    for each in flight.violations:
        print(f"{each.rule} at {each.t:.3f} s: {each.text}")
    nursery.close()
    return int(bool(flight.violations))


if __name__ == "__main__":
    sys.exit(main())
