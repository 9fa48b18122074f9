"""Names for notebooks and plug-ins, which import them from `zenpark` and from nowhere else (docs/python.md).

Each is imported when it is first asked for: a plug-in in the process of a robot loads what it names, and no numpy.
"""

from __future__ import annotations

from functools import cache
from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from agents.body.byte_stream import MalformedStream
    from agents.body.capture_reader import CaptureFrame, CaptureReader, MeasuredPose
    from agents.body.device_address import DeviceAddress
    from agents.body.device_locks import Claims
    from agents.body.interface import Body, BodyEntry, BodyError, BodyFault, BodyRequest, BodyState, call_all
    from agents.body.kinds import KINDS, Flight, Holonomic, Kind, Steered, Wheels
    from agents.formation.link import BY_BEARING, BY_DISTANCE, BY_NOTHING, BY_RELATIVE, Link
    from agents.network.keys import Keys
    from agents.network.messages import RunOrder
    from agents.plugins.avoidance import Avoidance, measure_gap
    from agents.plugins.cells import law_file
    from agents.plugins.law import (
        Control,
        Law,
        Measure,
        Memory,
        NeighbourView,
        RobotFacts,
        Said,
        Severity,
        Values,
        View,
        is_known,
    )
    from agents.plugins.laws import Gradient
    from agents.plugins.planners import Planner
    from agents.plugins.predictors import Predictor
    from agents.plugins.registry import PluginError
    from agents.plugins.triggers import Trigger, TriggerView
    from agents.vectors import NotNegative, Positive, Vector, clamp, difference, distance, norm, wrap
    from experiments.check.check import check, figures
    from experiments.definition import formation, graph, rigidity
    from experiments.file.document import Document, load, loads
    from experiments.learning.environment import Environment
    from experiments.learning.vector import Environments, SingleAgent
    from experiments.metrics import signals
    from experiments.metrics.metric import Metric
    from experiments.metrics.signals import Measurement
    from experiments.real_time.conductor.orders import send_run_order
    from experiments.recording.trace import Trace
    from experiments.report import style
    from experiments.run import fly, folder, reopen, reopen_seeds, show, simulate
    from experiments.sweep import pareto
    from experiments.sweep.sweep import sweep
    from twins.arrays import Array
    from twins.engines.engine import EngineFactory
    from twins.engines.point_mass import PointMassEngine, moving_models
    from twins.models.ground import Ground

__all__ = [  # noqa: RUF022 - by subject, as in docs/python.md
    # what most notebooks and plug-ins need
    "load", "loads", "check", "simulate", "sweep", "reopen", "show",
    "Law", "Gradient", "Control", "Said", "Trigger", "Planner", "Metric", "Trace",
    # more of experiments
    "Document", "figures", "reopen_seeds", "folder", "law_file", "fly",
    # learning
    "Environment", "Environments", "SingleAgent",
    # what laws and metrics get and raise
    "View", "NeighbourView", "Memory", "Values", "is_known", "Measure", "RobotFacts", "Severity", "Link", "PluginError",
    "BY_DISTANCE", "BY_RELATIVE", "BY_BEARING", "BY_NOTHING", "Measurement", "Array", "Positive", "NotNegative",
    # other bases of plug-ins
    "TriggerView", "Predictor", "Avoidance", "measure_gap", "EngineFactory", "PointMassEngine", "moving_models",
    # kinds and bodies
    "Kind", "KINDS", "Wheels", "Steered", "Holonomic", "Flight", "Ground",
    "Body", "BodyRequest", "BodyState", "BodyError", "BodyEntry", "BodyFault", "DeviceAddress", "Claims",
    "call_all",
    # readers of motion capture
    "CaptureReader", "CaptureFrame", "MeasuredPose", "MalformedStream",
    # vectors
    "Vector", "norm", "distance", "difference", "clamp", "wrap",
    # orders to a run in real time
    "RunOrder", "Keys", "send_run_order",
    # modules of theory and of figures
    "graph", "rigidity", "formation", "signals", "pareto", "style",
]  # fmt: skip


@cache
def homes() -> dict[str, str]:
    """Module of each name, as the imports above have it."""
    import ast  # noqa: PLC0415 - with the first name
    from pathlib import Path  # noqa: PLC0415 - likewise

    nodes = [
        each for each in ast.walk(ast.parse(Path(__file__).read_text("utf-8"))) if isinstance(each, ast.ImportFrom)
    ]
    found = {alias.name: node.module or "" for node in nodes for alias in node.names}
    return {name: found[name] for name in __all__}


@cache
def __getattr__(name: str) -> Any:  # noqa: ANN401 - a class, a function or a module
    """Object behind a name; raises AttributeError, with the nearest name, if there is none."""
    if name not in __all__:
        message = f"module 'zenpark' has no attribute {name!r}"
        if not name.startswith("__"):  # those Python itself asks for
            from agents.errors import did_you_mean  # noqa: PLC0415 - in trouble only

            message += f"; {did_you_mean(name, __all__)}"
        raise AttributeError(message, name=name)
    home = homes()[name]
    found = getattr(import_module(home), name, None)
    return import_module(f"{home}.{name}") if found is None else found


def __dir__() -> list[str]:
    return sorted(__all__)
