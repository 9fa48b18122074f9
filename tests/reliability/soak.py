"""`./zenpark test --soak`: an experiment for hours, and whether anything grows, is lost, slows down or dies.

Everything is written down as it comes: the processes that are measured keep no samples.
"""

from __future__ import annotations

from typing import Annotated

import typer

from agents.errors import ExplainedError
from agents.runtime.command_line import interrupts
from experiments.file.document import chosen, load
from experiments.real_time.conductor.conduct import RunOptions, Supervision, conduct
from experiments.real_time.conductor.run_view import RunFailed
from experiments.recording.run_folder import new_folder
from tests.reliability.soak_sampler import Sampler
from tests.reliability.soak_verdict import judge, passed, table
from tests.reliability.terminal import report_lines
from tools.options import AsJson, Bodies, Case, Out, Settings, print_result


def soak(
    file: Annotated[str, typer.Argument(metavar="[FILE]", help="Experiment file.")] = "endurance",
    *,
    minutes: Annotated[float, typer.Option(min=0.1, max=1440.0, help="How long.")] = 60.0,
    case: Case = None,
    out: Out = None,
    settings: Settings = None,
    bodies: Bodies = None,
    as_json: AsJson = False,
) -> int:
    """Run an experiment for long and say whether anything grows, is lost, slows down or dies."""
    read = load(file, *(settings or []), f"duration_s={60.0 * minutes!r}")
    name = case or next(iter(read.cases()))
    folder = new_folder(read, out)
    sampler = Sampler(chosen(read, [name])[name], folder, name)
    with interrupts() as interrupted:
        user = Supervision(sampler, interrupted)
        try:
            ended = conduct(read, folder, RunOptions([name], bodies, here=True), user)
            if ended.failures and not interrupted():
                sampler.end_early(RunFailed("; ".join(ended.failures)))
        except ExplainedError as error:
            sampler.end_early(error)
        soaked = sampler.result(interrupted=interrupted() or bool(user.emergency))
    findings = judge(soaked)
    well = passed(findings)
    shown = {"run": folder, "passed": well, "findings": findings}
    print_result(shown, *report_lines(table(soaked), findings), f"results: {folder}", as_json=as_json)
    if soaked.interrupted:
        return 130
    return 0 if well else 1
