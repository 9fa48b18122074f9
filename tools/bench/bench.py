"""`zenpark bench`: speed of this machine; each figure with a ratio to a baseline that was measured in the same run.

Machines are noisy and differ: a figure alone says little. CPU times are medians; the unit of work is a loop of small
numpy operations, the kind of work that a tick is made of.
"""

from __future__ import annotations

import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Final

import typer

from tools.commands.options import AsJson

if TYPE_CHECKING:
    from tools.bench.bench_figure import Figure


app: Final = typer.Typer()


def unit_of_work() -> float:
    """CPU time [s] of 10,000 small numpy operations: the yardstick."""
    import numpy as np

    a, b = np.ones((7, 3)), np.full((7, 3), 0.5)
    begin = time.process_time()
    for _ in range(5000):
        b = np.maximum(a - b, 0.1)
    return time.process_time() - begin


def virtual() -> Iterator[Figure]:
    """The reference experiment in virtual time, with and without a recording."""
    import tempfile

    from experiments.file.document import load
    from experiments.run import simulate, simulate_seeds
    from tools.bench.bench_figure import Figure, cpu

    read = load("robotic-park")
    span = read.experiment.duration_s
    yardstick = cpu(unit_of_work)
    yield Figure("virtual", "10,000 numpy operations", yardstick, "s CPU", 1.0, "yardstick")
    for case in read.cases():
        simulate(read, cases=[case])  # warm up
        taken = cpu(lambda case=case: simulate(read, cases=[case]))  # type: ignore[misc]
        yield Figure("virtual", f"{case}, {span:g} s", taken, "s CPU", span / taken, "× real time")

        def recorded(case: str = case) -> None:
            with tempfile.TemporaryDirectory() as folder:
                simulate(read, cases=[case], folder=Path(folder))

        taken = cpu(recorded)
        yield Figure("virtual", f"{case}, {span:g} s, recorded", taken, "s CPU", span / taken, "× real time")
    seeds = 20
    taken = cpu(lambda: simulate_seeds(read, range(seeds), cases=["event"]), 1)
    yield Figure("virtual", f"event, {seeds} seeds side by side", taken, "s CPU", seeds * span / taken, "× real time")


def codec() -> Iterator[Figure]:
    """A pose on the wire."""
    from agents.network import messages
    from tools.bench.bench_figure import Figure, cpu

    count = 20_000
    pose = messages.pose("CF01", 123456, 1.7e9 + 0.123456, [0.123456, -0.5, 0.8], [0.01, 0.02, 0.0], 0.1)
    encodings: tuple[messages.Encoding, ...] = ("json", "msgpack")
    first = 0.0
    for encoding in encodings:
        payload = messages.encode(pose, encoding)
        mime = messages.MIME[encoding]

        def both(encoding: messages.Encoding = encoding, payload: bytes = payload, mime: str = mime) -> None:
            for _ in range(count):
                messages.encode(pose, encoding)
                messages.decode(payload, mime, messages.Pose)

        taken = cpu(both) / count * 1e6
        first = first or taken
        yield Figure(
            "codec", f"pose out and in, {encoding} ({len(payload)} B)", taken, "µs CPU", taken / first, "× JSON"
        )


def start() -> Iterator[Figure]:
    """How long a command takes to answer."""
    import statistics
    import subprocess

    from tools.bench.bench_figure import REPEATS, Figure

    def wall(*arguments: str) -> float:
        taken = []
        for _ in range(REPEATS):
            begin = time.monotonic()
            subprocess.run([sys.executable, *arguments], check=True, stdout=subprocess.DEVNULL)
            taken.append(time.monotonic() - begin)
        return 1e3 * statistics.median(taken)

    bare = wall("-c", "pass")
    yield Figure("start", "python that does nothing", bare, "ms", 1.0, "yardstick")
    answer = wall("-m", "tools.guard", "--help")
    yield Figure("start", "zenpark --help", answer, "ms", answer / bare, "× bare python")


@app.command()
def bench(
    names: Annotated[
        list[str] | None,
        typer.Argument(
            metavar="[NAME...]", help="start, codec, virtual, process, world, encounters, safety or intruders."
        ),
    ] = None,
    as_json: AsJson = False,
) -> int:
    """Measure what this machine can do, each figure beside a baseline."""
    import json

    import msgspec

    benchmarks = _benchmarks()
    if unknown := [name for name in names or () if name not in benchmarks]:
        print(f"zenpark: no benchmark '{unknown[0]}'; there are: {', '.join(benchmarks)}", file=sys.stderr)
        return 2
    figures = []
    for name in names or benchmarks:
        for figure in benchmarks[name]():
            figures.append(figure)
            if not as_json:
                value = f"{figure.name:<50} {figure.value:10.3g} {figure.unit:<12}"
                print(
                    f"{figure.benchmark:<10} {value} {figure.ratio:8.3g} {figure.baseline}",
                    flush=True,
                )
    if as_json:
        print(json.dumps(msgspec.to_builtins(figures)))
    return 0


def _benchmarks() -> dict[str, Callable[[], Iterator[Figure]]]:
    """All benchmarks by name, in the order in which they are made."""
    from tools.bench import intruders, process, reactions, worlds

    return {
        "start": start,
        "codec": codec,
        "virtual": virtual,
        "process": process.process,
        "world": worlds.world,
        "encounters": worlds.encounters,
        "safety": reactions.safety,
        "intruders": intruders.intruders,
    }
