"""Measurements of zenpark itself: `./zenpark test --chaos`, `--soak` and `--bench`."""

from __future__ import annotations

import sys

import typer

from tests.bench.bench import bench
from tests.reliability.chaos import chaos
from tests.reliability.soak import soak
from tools.main import call
from tools.options import example

MEASUREMENTS = {
    "--chaos": (chaos, ("triangle --faults 20 --seed 1", "triangle --kinds kill,pause")),
    "--soak": (soak, ("--minutes 60", "triangle --minutes 10")),
    "--bench": (bench, ("start", "process --json")),
}


def command(option: str) -> typer.Typer:
    """The command line behind an option of `./zenpark test`."""
    function, examples = MEASUREMENTS[option]
    made = typer.Typer(
        add_completion=False,
        rich_markup_mode=None,
        pretty_exceptions_enable=False,
        context_settings={"help_option_names": ["-h", "--help"]},
    )
    made.command(epilog=example(*(f"test {option} {words}" for words in examples)))(function)
    return made


if __name__ == "__main__":
    asked = sys.argv.pop(1)
    call(command(asked), f"zenpark test {asked}")
