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

from tests.simulated.experiments import FIXED, LONG, NAMES, RANDOM, setting_of
from tests.simulated.faults import KINDS, Fault
from tests.simulated.laboratory import Flight, Nursery, Request, SimulatorError

SHRINK_S = 60.0  # processor time of a search
QUICK = 1000  # seeds below it are short flights


def request_of(seed: int, name: str | None = None, kinds: Sequence[str] = ()) -> Request:
    """The flight of a seed: its experiment, unless one is named, its script, lateness, and times of starts."""
    names = [*FIXED, RANDOM, RANDOM]
    setting = setting_of(name or names[seed % len(names)], seed)
    rng = random.Random(f"request {seed}")
    lasts = () if name in LONG else (f"duration_s={4 if seed < QUICK else 8}",)
    clock = rng.choice((0.03, -0.03, 0.4, -0.4, 2.0, -2.0, 4.5, -4.5, 20.0, -20.0))
    return Request(
        setting.experiment,
        seed=seed,
        case=setting.case,
        settings=(*setting.settings, *lasts),
        preempt=rng.choice((0.0, 0.002, 0.03)),
        varied=rng.random() < 0.6,
        clocks={rng.choice(("KH01", "CF01", "A", "B")): clock} if rng.random() < 0.15 else {},
        forgets=rng.choice((0.0, 0.0, 0.5)),
        drawn=seed,
        kinds=tuple(kinds),
        sites=setting.sites,
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


@dataclass(frozen=True)
class Choice:
    """Choice of a campaign: an experiment, and kinds of faults; all of both if they are left out."""

    name: str | None = None
    kinds: tuple[str, ...] = ()

    def request(self, seed: int) -> Request:
        return request_of(seed, self.name, self.kinds)

    def repeat(self, seed: int) -> str:
        """The command that repeats a flight."""
        name = f" --of {self.name}" if self.name else ""
        kinds = f" --kinds {' '.join(self.kinds)}" if self.kinds else ""
        return f"python -m tests.simulated.campaign --one {seed}{name}{kinds} -v"


ALL = Choice()


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


def fly(seeds: Iterable[int], choice: Choice, nursery: Nursery) -> Iterator[tuple[int, Flight | SimulatorError]]:
    for seed in seeds:
        try:
            yield seed, nursery.run(choice.request(seed))
        except SimulatorError as error:
            yield seed, error


def failure(seed: int, choice: Choice, nursery: Nursery, flight: Flight | SimulatorError) -> str:
    """Rules that a seed breaks, its shrunk script, and the command that repeats it; empty if all is well."""
    if isinstance(flight, SimulatorError):
        return f"seed {seed}: {flight}\n  {choice.repeat(seed)}"
    if not flight.violations:
        return ""
    script, least = shrink(choice.request(seed), flight, nursery)
    lines = [f"seed {seed}, exit code {flight.code}: {choice.repeat(seed)}"]
    lines += [f"  {each.rule} at {each.t:.2f} s: {each.text}" for each in least.violations]
    return "\n".join([*lines, *(f"    {fault}" for fault in script)])


def campaign(seeds: Sequence[int], choice: Choice, processes: int) -> int:
    """Fly seeds in some processes at a time, and print what they break; the exit code."""
    total, rules, codes, waiting = Sum(), Counter[str](), Counter[int | None](), iter(seeds)
    begun = time.monotonic()

    def work(_: int) -> None:
        nursery = Nursery()
        for seed in waiting:
            for _seed, flight in fly([seed], choice, nursery):
                if isinstance(flight, Flight):
                    total.add(flight)
                    if total.flights % 25 == 0:
                        print(f"{total}; broken {dict(rules)}", file=sys.stderr, flush=True)
                    codes[flight.code] += 1
                    rules.update(broken(flight))
                else:
                    rules["simulator"] += 1
                if text := failure(seed, choice, nursery, flight):
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
    parser.add_argument("--kinds", nargs="+", default=(), choices=list(KINDS), help="kinds of faults")
    given = parser.parse_args()
    choice = Choice(given.of, tuple(given.kinds))
    if given.one is None:
        first, count = given.seeds or (1, 200)
        return campaign(list(itertools.islice(itertools.count(first), count)), choice, given.processes)
    nursery = Nursery()
    flight = nursery.run(choice.request(given.one))
    if given.shrink:
        print(failure(given.one, choice, nursery, flight))
    if given.v:
        print(flight.describe())
    for each in flight.violations:
        print(f"{each.rule} at {each.t:.3f} s: {each.text}")
    nursery.close()
    return int(bool(flight.violations))


if __name__ == "__main__":
    sys.exit(main())
