"""Consistency of an experiment: faults that no single field shows."""

from __future__ import annotations

from collections.abc import Collection, Iterable, Iterator

from agents.body.kinds import KINDS
from agents.errors import did_you_mean
from agents.plugins import files, registry
from agents.plugins.laws import Gradient
from agents.plugins.predictors import HOLD
from experiments.definition.experiment import MEAN, WORST, Experiment, Hybrid
from experiments.definition.plan import Plan
from experiments.file.choices import usable_metric
from experiments.file.consistency import network
from experiments.file.consistency.arena import arena_faults
from experiments.file.consistency.formation import formation_faults
from experiments.file.consistency.robots import positioning_faults, robot_faults
from experiments.file.problems import Fault, Path, after_the_end, unknown_robot


def consistency_faults(plan: Plan) -> Iterator[Fault]:
    """All contradictions between fields, with their paths in the file."""
    experiment = plan.experiment
    yield from _numbers(experiment)
    yield from _case_names(experiment.cases)
    yield from _architecture(experiment)
    yield from _timeline(experiment)
    yield from _choices(plan)
    yield from robot_faults(experiment, plan.engine)
    yield from positioning_faults(experiment)
    yield from arena_faults(experiment.arena, experiment.robots)
    yield from formation_faults(plan)
    yield from network.channel_faults(plan)
    yield from network.host_faults(experiment)


def judged_metrics() -> list[str]:
    """Metrics that a criterion can name."""
    # a path, because the module of the figures imports those of files
    figures = registry.find("experiments.metrics.metric:FIGURES", "metrics of zenpark")
    return [*figures, *registry.names(registry.METRICS)]


def criteria_faults(experiment: Experiment, cases: Collection[str]) -> Iterator[Fault]:
    """Faults of the criteria and metrics of a file with these cases."""
    for number, name in enumerate(experiment.metrics):
        yield from _metric_faults(name, ("metrics", number))
    for number, each in enumerate(experiment.criteria):
        path = ("criteria", number)
        if each.metric is not None:
            yield from _metric_faults(each.metric, (*path, "metric"))
        if each.of not in (known := [MEAN, WORST, *experiment.robots]):
            yield Fault((*path, "of"), f"no robot is called '{each.of}'", did_you_mean(each.of, known))
        for key in ("case", "relative_to"):
            name = getattr(each, key)
            if name is not None and name not in cases:
                yield Fault((*path, key), f"no case '{name}' in this experiment", did_you_mean(name, cases))


def _metric_faults(name: str, path: Path) -> Iterator[Fault]:
    if files.is_choice(name):
        try:
            usable_metric(name)
        except registry.PluginError as error:
            yield Fault(path, str(error), "mend that file (docs/metrics.md)")
    elif name not in (known := judged_metrics()):
        yield Fault(path, f"no {name!r} among the metrics", did_you_mean(name, known))


def _case_names(names: Iterable[str]) -> Iterator[Fault]:
    """Faults of cases with the same file name on systems that ignore capitals."""
    former: dict[str, str] = {}
    for name in names:
        other = former.setdefault(name.lower(), name)
        if other != name:
            message = f"'{name}' and '{other}' differ by capitals only, and so would their recordings"
            yield Fault(("cases", name), message, "rename one of them", on_key=True)


def _numbers(experiment: Experiment) -> Iterator[Fault]:
    """Rates that do not divide, a margin that fills the arena, a run without telemetry."""
    body = experiment.rates.body_hz
    for name in ("pose_hz", "coordination_hz", "state_hz"):
        ratio = body / getattr(experiment.rates, name)
        if abs(ratio - max(1, round(ratio))) > 1e-9 * ratio:
            hint = f"the nearest that does: {name} = {divisor(body, body / ratio):g}"
            yield Fault(("rates", name), f"{name} = {body / ratio:g} does not divide body_hz = {body:g}", hint)

    width, depth, _ = experiment.arena.size
    radii = {kind.name: kind.radius for kind in KINDS.usable()}
    largest = max((radii.get(robot.kind, 0.0) for robot in experiment.robots.values()), default=0.0)
    margin, widest = experiment.safety.margin, max(min(width, depth) / 2.0 - largest, 0.0)
    if margin >= widest:  # every goal would be clamped to beyond the middle, where the robots meet
        message = f"a margin of {margin:g} m leaves no place for goals in an arena of {width:g} by {depth:g} m"
        yield Fault(("safety", "margin"), message, f"give less than {widest:g}, in metres, or enlarge size in [arena]")

    samples = experiment.duration_s * experiment.rates.state_hz
    if samples < 1.0 - 1e-9:
        message = f"duration_s = {experiment.duration_s:g} holds less than two samples of telemetry"
        hint = f"give it {1.0 / experiment.rates.state_hz:g} s or more, or raise rates.state_hz"
        yield Fault(("duration_s",), message, hint)


def divisor(body: float, wanted: float) -> float:
    """The nearest rate that divides `body` and can be written in a few digits."""
    written = (float(f"{body / times:g}") for times in range(1, 1001))
    exact = [rate for times, rate in enumerate(written, 1) if rate * times == body]
    return min(exact, key=lambda rate: abs(rate - wanted), default=body)


def _choices(plan: Plan) -> Iterator[Fault]:
    """Plug-ins that do not fit: triggers in the wrong place or without their prediction, and what a law excludes.

    A law that is no gradient decides without errors of links, and its memory is the robot's own.
    """
    experiment, trigger, update, law = plan.experiment, plan.trigger, plan.update, plan.law
    if "communication" not in trigger.PLACES:
        kind = plan.trigger_name
        message = f"'{kind}' decides when the law is recomputed, not when a robot transmits"
        yield Fault(("trigger",), message, f"put it into [formation] as update = '{kind}', and another trigger here")
    if experiment.prediction is not None and plan.needs_prediction and plan.predictor is HOLD:
        believes = "counts on neighbours that extrapolate, but prediction = 'hold' says that they do not"
        hint = f"leave prediction out, which means '{trigger.PREDICTION}', or take the trigger send-on-delta"
        yield Fault(("prediction",), f"'{plan.trigger_name}' {believes}", hint)
    if update is not None and "control" not in update.PLACES:
        message = f"'{plan.update_name}' decides when a robot transmits, not when the law is recomputed"
        yield Fault(("formation", "update"), message, "take another one, such as send-on-delta or relative-control")
    if update is not None and update.smoothing_s:
        message = "smoothing_s is for transmissions, and there are none where the law is computed"
        yield Fault(("formation", "update", "smoothing_s"), message, "leave it out", on_key=True)
    if isinstance(law, Gradient):
        return
    if update is not None:
        message = f"the law '{plan.law_name}' is no function of its input alone: a step that is left out would be lost"
        yield Fault(("formation", "update"), message, "leave update out", on_key=True)
    if isinstance(experiment.architecture, Hybrid) and law.SAYS:
        message = f"guided robots transmit no variables, and '{plan.law_name}' needs them: their free neighbours would"
        hint = 'write architecture = "centralised" or "distributed", or take another law'
        yield Fault(("architecture",), f"{message} receive nothing", hint, on_key=True)
    if experiment.formation.anchors:
        message = f"anchors pull robots of laws that pull along links; '{plan.law_name}' does not know them"
        yield Fault(("formation", "anchors"), message, "leave anchors out", on_key=True)
    if trigger.JUDGES_ERRORS:
        message = f"'{plan.trigger_name}' judges errors of links, by which the law '{plan.law_name}' does not pull"
        yield Fault(("trigger",), message, "take another trigger, such as send-on-delta")
    elif trigger.JUDGES_DRIFT and law.SAYS:
        message = (
            f"'{plan.trigger_name}' waits by how the pose drifts; it does not see the variables that '{plan.law_name}' "
            "says"
        )
        yield Fault(("trigger",), message, "take another trigger, such as send-on-delta")


def _architecture(experiment: Experiment) -> Iterator[Fault]:
    """A hybrid architecture must name some of the robots, and not all."""
    hybrid, path = experiment.architecture, ("architecture", "robots")
    if not isinstance(hybrid, Hybrid):
        return
    for number, name in enumerate(hybrid.robots):
        yield from unknown_robot((*path, number), name, experiment.robots)
        if name in hybrid.robots[:number]:
            yield Fault((*path, number), f"'{name}' is named twice", "name it once")
    if set(experiment.robots) <= set(hybrid.robots):
        message = "a hybrid architecture in which the centre guides every robot is a centralised one"
        yield Fault(path, message, 'write architecture = "centralised", or leave some robots out')


def _timeline(experiment: Experiment) -> Iterator[Fault]:
    before: dict[str, float] = {}
    for number, leg in enumerate(experiment.timeline):
        path = ("timeline", number)
        yield from unknown_robot((*path, "robot"), leg.robot, experiment.robots)
        yield from after_the_end((*path, "at_s"), "leg", leg.at_s, experiment.duration_s)
        if leg.at_s <= before.get(leg.robot, -1.0):
            message = f"this leg of '{leg.robot}' begins at {leg.at_s:g} s, not after the one before it"
            hint = f"sort its legs by time; the one before begins at {before[leg.robot]:g} s"
            yield Fault((*path, "at_s"), message, hint)
        before[leg.robot] = max(leg.at_s, before.get(leg.robot, -1.0))
