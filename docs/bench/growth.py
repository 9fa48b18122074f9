"""Growth of a run in virtual time with the number of robots: CPU time of an agent-step and of the rest, memory.

`python -m docs.bench.growth`. Each number has processes of its own, plain and compiled, measured in turns with those
of seven robots. Figures are medians; all but the agent-steps are of the compiled flights.
"""

import statistics

from docs.bench.drivers.peer_zenpark import DURATION_S
from docs.bench.peers import COMPILED_WHEELS, WHEELS, measured
from tests.bench.measuring import markdown

# simulated time [s] by number of robots: a compiled flight of seven takes milliseconds for ten seconds
DURATIONS = {7: 300.0, 30: 70.0, 100: 21.0, 300: 10.0, 1000: 5.0, 3000: 3.0, 10_000: 3.0}
COMPLETE = 300  # robots up to which metrics are taken as well
ROUNDS = 3
MANY = 1000  # robots from which on a number is measured once
SETTINGS = (WHEELS, COMPILED_WHEELS)
COLUMNS = {  # figure of the driver: heading, format
    "read_s": ("read [s]", ".2f"),
    "start_s": ("before [s]", ".2f"),
    "cpu_s": ("loop [s]", ".2f"),
    "metrics_s": ("metrics [s]", ".2f"),
    "memory_mb": ("memory [MB]", ".0f"),
}


def report(sizes=tuple(DURATIONS), rounds=ROUNDS, settings=SETTINGS):
    """The table, in Markdown."""
    headings = ["robots", "simulated [s]"]
    for name in settings:
        headings += [f"{name.split()[-1]}: µs per agent-step", "ratio to 7 robots"]
    headings += [heading for heading, _ in COLUMNS.values()]
    return markdown([headings, *(line(robots, rounds, settings) for robots in sizes)])


def line(robots, rounds, settings):
    """Cells of the line of a number of robots."""
    simulated_s = DURATIONS.get(robots, DURATION_S)
    span = f"{simulated_s:g}", "all" if robots <= COMPLETE else "loop"
    found = {name: [] for name in settings}
    for _ in range(rounds if robots < MANY else 1):
        for name, figures in found.items():
            one, seven = measured(name, robots, *span), measured(name, 7, f"{DURATIONS[7]:g}", "loop")
            step_us, of_seven_us = (1e6 * each["cpu_s"] / each["agent_steps"] for each in (one, seven))
            figures.append({**one, "step_us": step_us, "ratio": step_us / of_seven_us})
    cells = [f"{robots:,}", f"{simulated_s:g}"]
    for figures in found.values():
        cells += [f"{statistics.median(each[what] for each in figures):.2g}" for what in ("step_us", "ratio")]
    for figure, (_, form) in COLUMNS.items():
        values = [each[figure] for each in found[settings[-1]] if figure in each]
        cells.append(f"{statistics.median(values):{form}}" if values else "")
    return cells


if __name__ == "__main__":
    print(report())
