"""A robot's process: `python -m experiments.robot FILE NAME ...`. Light to start, for an experiment starts many.

`zenpark agent` is the same for people; the launcher starts this, which needs neither typer nor what typer needs.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from typing import Final

from agents import plugins
from agents.body import BodyError
from agents.fleet import assemble
from agents.keys import Keys
from agents.runtime import NameTaken, Ranging, Runtime, Setup
from agents.session import DEFAULT_ENDPOINT, EndpointError, Unreachable
from agents.shadow import shadowed
from experiments import assign, conditions, document
from experiments.experiment import Experiment, Robot
from experiments.problem import DocumentError, Problem
from experiments.reach import routers

FAR: Final = ("external", "world")  # bodies that live in another process, their range sensors too


def fly(
    file: str,
    names: Sequence[str],
    *,
    case: str | None,
    connect: Sequence[str],
    lifeline: bool,
    lab: str | None = None,
) -> int:
    """Runs the robots `names` of an experiment in this process; returns its exit code.

    Raises:
        DocumentError: If the file is wrong, or has no such robot or case.
        BodyError, UnknownPlugin: If a body cannot be had.
        Unreachable: If no router answers.
    """
    read = document.read(file)
    experiment = chosen_case(read, case)
    unknown = [name for name in names if name not in experiment.robots]
    if unknown:
        hint = plugins.did_you_mean(unknown[0], experiment.robots)
        raise DocumentError([Problem(file, 0, 0, f"no robot '{unknown[0]}' in this experiment", hint)])
    endpoints = routers(experiment, read.path, connect, lab) or [DEFAULT_ENDPOINT]
    request = assign.request(experiment, names, [experiment.seed], endpoints)
    body = shadowed(assemble(request), request, assign.shadows(experiment, names))
    assignment = assign.assign(experiment, names)
    setup = Setup(
        keys=Keys(experiment.network.realm),
        endpoints=endpoints,
        encoding=experiment.network.encoding,
        state_hz=experiment.rates.state_hz,
        lifeline=lifeline,
        located=[experiment.robots[name].position == "external" for name in names],
        ranging=[_ranging(experiment.robots[name]) for name in names],
        conditions=conditions.at_listeners(experiment, assignment.links, names),
    )
    return Runtime(assignment, body, setup).run()


def _ranging(robot: Robot) -> Ranging:
    """Where a robot's range readings come from: bodies in other processes hear them by themselves."""
    if plugins.body_name(robot.body) in FAR:
        return "far"
    return robot.ranges


def chosen_case(read: document.Document, name: str | None) -> Experiment:
    """A case of an experiment by name; the first if none is named.

    Raises:
        DocumentError: If it has no such case.
    """
    cases = read.cases()
    if name is None:
        return next(iter(cases.values()))
    if name not in cases:
        hint = plugins.did_you_mean(name, cases)
        raise DocumentError([Problem(str(read.path), 0, 0, f"no case '{name}' in this experiment", hint)])
    return cases[name]


def main(arguments: Sequence[str] | None = None) -> int:
    """The command line of the process."""
    parser = argparse.ArgumentParser(prog="zenpark agent", description="Robots of an experiment in one process.")
    parser.add_argument("file", help="experiment file, or name in the catalogue")
    parser.add_argument("names", nargs="+", metavar="ROBOT")
    parser.add_argument("--case", help="which case of the file; the first if left out")
    parser.add_argument("--connect", action="append", metavar="ENDPOINT", default=[], help="router")
    parser.add_argument("--lifeline", action="store_true", help="land and end when standard input ends or is silent")
    chosen = parser.parse_args(arguments)
    try:
        return fly(chosen.file, chosen.names, case=chosen.case, connect=chosen.connect, lifeline=chosen.lifeline)
    except (DocumentError, BodyError, NameTaken, plugins.PluginError, EndpointError, Unreachable) as error:
        print(f"zenpark: {error}", file=sys.stderr)
        return 2


if __name__ == "__main__":
    sys.exit(main())
