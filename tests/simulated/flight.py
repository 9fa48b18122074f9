"""A flight in the process itself, which can do nothing else afterwards; `tests.simulated.laboratory` forks it."""

from __future__ import annotations

import gc
import importlib
import json
import os
import pkgutil
from collections.abc import Iterator
from contextlib import ExitStack, suppress
from math import inf
from pathlib import Path
from types import CodeType, FunctionType

from agents.decision.lifecycle import Phase
from experiments.file.document import load
from tests.simulated import faults, kernel, laboratory, processes, rules, seam, world
from tests.simulated.experiments import MIX
from tests.simulated.laboratory import Flight, Mutant, Request, SimulatorError

for _package in ("agents", "experiments", "tools", "twins"):  # an import in a flight would take real time
    for _module in pkgutil.walk_packages(importlib.import_module(_package).__path__, f"{_package}."):
        with suppress(ImportError):
            importlib.import_module(_module.name)

_for_good = ExitStack()


def fly(request: Request) -> Flight:
    """Fly a request, and collect what was seen."""
    if request.mutant is not None:
        mutate(request.mutant)
    folder = laboratory.scratch() if request.folder is None else Path(request.folder)
    begun = processes.REAL.process_time()
    try:
        file = _file(request, folder)
        words, script = _command(request, file, folder), _script(request, file)
        os.environ["ZENPARK_RUNTIME_DIR"] = os.environ["ZENPARK_CACHE_DIR"] = str(folder / "user")
        with kernel.Kernel(request.seed, request.preempt) as running:
            laboratory_world = world.World(running, script, varied=request.varied, clocks=request.clocks)
            laboratory_world.network.forgets = request.forgets
            checked = rules.Rules(laboratory_world)
            laboratory_world.run(words, request.limit_s, _sites(request))
            checked.judge(folder / "run")
            flight = _collect(laboratory_world, checked, request, folder / "run")
        flight.cpu_s = processes.REAL.process_time() - begun
        return flight
    finally:
        if request.folder is None:
            laboratory.forget(folder)


def warm_up() -> None:
    """Do once what each flight would do again, and keep the garbage collector off all that.

    Two short flights fill caches and let the interpreter adapt its code.
    """
    _for_good.enter_context(kernel.guard())
    seam.patch()
    for case in ("event", "world"):
        fly(Request(MIX, case=case, settings=("duration_s=1",)))
    gc.collect()
    gc.freeze()
    gc.disable()  # a flight is short, and its end would depend on what was there before


def leave() -> None:
    """End this process."""
    processes.REAL.exit(0)


def _file(request: Request, folder: Path) -> str:
    """The experiment as the command takes it: a name of the catalogue, or a file with its text."""
    if "\n" not in request.experiment:
        return request.experiment
    folder.mkdir(parents=True, exist_ok=True)
    file = folder / "experiment.toml"
    file.write_text(request.experiment, "utf-8")
    return str(file)


def _command(request: Request, file: str, folder: Path) -> list[str]:
    chosen = [] if request.case is None else ["--case", request.case]
    settings = [word for setting in _settings(request) for word in ("--set", setting)]
    return ["run", file, *chosen, *settings, "--no-report", "--out", str(folder / "run"), *request.words]


def _sites(request: Request) -> list[str]:
    """Endpoints of routers that run already."""
    return [f"tcp/127.0.0.1:{7447 + number}" for number in range(request.sites)]


def _settings(request: Request) -> tuple[str, ...]:
    return (*request.settings, *([f"network.connect={json.dumps(_sites(request))}"] if request.sites else []))


def _script(request: Request, file: str) -> list[faults.Fault]:
    """The script, with random faults if some are drawn."""
    if request.drawn is None:
        return list(request.script)
    plans = load(file, *_settings(request)).cases()
    return faults.draw_for(plans[request.case or next(iter(plans))], request.drawn, request.kinds)


def mutate(mutant: Mutant) -> None:
    """Change the functions of a file in place, so that all that refer to them are changed."""
    module = importlib.import_module(mutant.file.removesuffix(".py").replace("/", "."))
    file = module.__file__
    assert file is not None
    text = Path(file).read_text("utf-8")
    if text.count(mutant.old) != 1:
        raise SimulatorError(f"{mutant.file}: {mutant.old!r} is there {text.count(mutant.old)} times, not once")
    before, after = (
        {code.co_qualname: code for code in _codes(compile(each, file, "exec"))}
        for each in (text, text.replace(mutant.old, mutant.new))
    )
    different = {name for name, code in after.items() if name in before and _body(code) != _body(before[name])}
    changed = 0
    gc.unfreeze()
    for each in gc.get_objects():
        if isinstance(each, FunctionType) and each.__code__.co_filename == file:
            name = each.__code__.co_qualname
            if name in different:
                each.__code__ = after[name]
                changed += 1
    if not changed:
        raise SimulatorError(f"{mutant.file}: {mutant.new!r} changes no function")


def _body(code: CodeType) -> tuple[object, ...]:
    """Code of a function, without its place in its file."""
    constants = tuple(_body(each) if isinstance(each, CodeType) else each for each in code.co_consts)
    return code.co_code, code.co_names, repr(constants)


def _codes(code: CodeType) -> Iterator[CodeType]:
    for each in code.co_consts:
        if isinstance(each, CodeType):
            yield each
            yield from _codes(each)


def _collect(seen: world.World, checked: rules.Rules, request: Request, folder: Path) -> Flight:
    """Plain data of all that was seen, in seconds after the common start."""
    zero = seen.moments.get("start", seen.moments["launch"])
    started = zero - seen.moments["launch"] if "start" in seen.moments else None

    def since(t: float) -> float:
        return round(t - zero, 6)

    robots = {name: laboratory.Track() for name in (seen.plan.names if seen.plan is not None else ())}
    for t, name, pid, phase, reason in seen.phases:
        robots[name].phases.append(laboratory.Phase(since(t), Phase(phase).word, reason, pid))
    for t, name, text in seen.hazards:
        robots[name].hazards.append((since(t), text))
    for t, name, missing in seen.missing:
        robots[name].missing.append((since(t), missing))
    for t, name, on in seen.motors:
        robots[name].motors.append((since(t), on))
    for name, samples in seen.samples.items():
        robots[name].samples = [laboratory.Sample(round(t - zero, 6), *rest) for t, *rest in samples]
    for rows, attribute in ((seen.commands, "commands"), (seen.poses, "poses")):
        for name, track in robots.items():
            setattr(track, attribute, [(round(t - zero, 6), pid) for t, who, pid in rows if who == name])
    utc = kernel.EPOCH
    metrics = folder / "metrics.json"
    processes = [
        laboratory.Ended(
            each.name, each.pid, since(each.started), since(seen.ends.get(each.pid, inf)), each.code, "".join(each.out)
        )
        for each in seen.kernel.processes
    ]
    return Flight(
        code=seen.conductor.code,
        output="".join(seen.conductor.out),
        started=started,
        ended=since(seen.ends.get(seen.conductor.pid, inf)),
        seed=request.seed,
        script=seen.script,
        robots=robots,
        events=[laboratory.Event(since(each.stamp - utc), each.kind, each.source, each.text) for each in seen.events],
        answers=[
            laboratory.Answer(since(t), who, words, process.code, "".join(process.out))
            for t, who, words, process in seen.answers
        ],
        processes=processes,
        violations=[laboratory.Violation(rule, since(t), text) for rule, t, text in checked.violations],
        crashes=[(since(t + kernel.BEGIN), process, text) for t, process, _, text in seen.kernel.crashes],
        notes=[(since(t), text) for t, text in seen.notes],
        metrics=json.loads(metrics.read_text("utf-8")) if metrics.is_file() else None,
        files=sorted(str(each.relative_to(folder)) for each in folder.rglob("*")) if folder.is_dir() else [],
        trace=seen.kernel.digest,
        robot_s=checked.robot_s,
        simulated_s=seen.now - kernel.BEGIN,
    )
