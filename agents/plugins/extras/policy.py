"""Learned policies: a law and a trigger from files in the ONNX format.

Their runtime, onnxruntime, is the extra `policy`, and loads with numpy at first use.
"""

from __future__ import annotations

from base64 import b64decode
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import lru_cache
from math import isfinite, nan
from typing import Annotated, Any, ClassVar, Final

from msgspec import Meta

from agents.plugins.extras.observation import Observation
from zenpark import (
    Control,
    Law,
    Measure,
    Memory,
    PluginError,
    RobotFacts,
    Severity,
    Trigger,
    TriggerView,
    Values,
    View,
)

PLANAR: Final = 2  # numbers of an action
JUDGED: Final = 3  # numbers that a learned trigger judges
MOST: Final = 1e6  # input of a learned trigger for an infinite number
ACTIONS: Final = ("velocity", "goal")
FLOAT: Final = "tensor(float)"
MEMORY: Final = "memory"  # variable with the state of a recurrent policy
OBSERVES, EACH, ACTION = "observes", "observes_each", "action"  # keys of the metadata of a model

Act = Callable[[Sequence[float], Values], tuple[Values, Values]]
Given = Annotated[str, Meta(description="ONNX file beside the experiment file: its name")]
Content = Annotated[str, Meta(description="content of that file, in base64: it goes with the experiment")]


@dataclass(frozen=True)
class LearnedModel:
    """A learned function: its sizes, its metadata, and `act`, from inputs and memory to outputs and memory."""

    size: int  # count of inputs
    result: int  # count of outputs
    memory: int  # count of numbers that it remembers
    metadata: Mapping[str, str]
    act: Act


class Policy(Law, frozen=True):
    """v_i = π(o_i): a policy that was learned elsewhere, from a file in the ONNX format.

    π takes one observation, float32. Its metadata name what that is, see docs/policy.md; without them it is 4 + 4n
    numbers: own x, y [m] and v_x, v_y [m/s]; then for each of n neighbours, by their numbers among the robots,
    p̂_j − p_i and the wanted p_j − p_i of the link, x and y each [m]. What is unknown or not there is 0. π gives v_x,
    v_y [m/s], or where to go from here [m]. What it guarantees is up to its author: avoidance and setpoint filter have
    the last word.
    """

    PREDICTION: ClassVar[str] = "constant-velocity"
    MEASURES: ClassVar[Mapping[str, Measure]] = {
        "wanted_x": Measure("m/s", better=""),
        "wanted_y": Measure("m/s", better=""),
    }
    LIBRARY: ClassVar[str] = "onnxruntime"
    FILES: ClassVar[Mapping[str, str]] = {"file": "model"}

    file: Given = ""
    model: Content = ""

    def begin(self, robot: RobotFacts) -> Memory:
        """State of a recurrent policy, 0 at first; raises PluginError for a model that cannot be used."""
        size = load(self.model)[1].memory
        return {MEMORY: (0.0,) * size} if size else {}

    def step(self, view: View, memory: Memory) -> Control:
        """Action for what is observed now."""
        observation, model = load(self.model)
        (x, y), state = model.act(observation.of(view), memory.get(MEMORY, ()))
        found, measures = {MEMORY: state} if state else {}, {"wanted_x": x, "wanted_y": y}
        return steered(view, x, y, model.metadata.get(ACTION, ACTIONS[0]), memory=found, measures=measures)

    def analyse(self, plan: Any) -> Iterable[tuple[Severity, str, str]]:  # noqa: ANN401 - as its base
        """Robots with more neighbours than the policy has places for."""
        observation, _ = load(self.model)
        for name in plan.experiment.robots:
            count, places = len(plan.assignment(name).neighbours), observation.places
            if observation.each and count > places:
                message = f"{name} has {count} neighbours, and the policy observes {places}: the last ones are left out"
                yield "warning", message, "take fewer links, or a policy with more inputs"


class PolicyTrigger(Trigger, frozen=True):
    """τ(‖ε‖, t − t_k, Σ|e|) > 0: a trigger that was learned elsewhere, from a file in the ONNX format.

    τ takes three numbers, float32, and gives one: the deviation [m], the time since the last event [s], and the error
    of the robot's links [m], 0 where it is unknown.
    """

    LIBRARY: ClassVar[str] = "onnxruntime"
    FILES: ClassVar[Mapping[str, str]] = {"file": "model"}

    file: Given = ""
    model: Content = ""

    def fires(self, view: TriggerView) -> bool:
        judged = view.deviation, view.since_event, view.error
        (found,), _ = load_trigger(self.model).act([_bounded(each) for each in judged], ())
        return found > 0.0


def steered(view: View, x: float, y: float, action: str, **others: Any) -> Control:  # noqa: ANN401 - of a control
    """Control of an action: a velocity [m/s], or a goal as seen from the robot [m]; heights are held."""
    if action == ACTIONS[0]:
        return Control(velocity=(x, y, nan), **others)
    return Control(goal=(view.position[0] + x, view.position[1] + y, nan), **others)


@lru_cache(maxsize=8)
def load(model: str) -> tuple[Observation, LearnedModel]:
    """Observation of a policy, and the policy; raises PluginError as `read`, or for a model that does not fit."""
    found = read(model, "law policy")
    about = found.metadata
    if found.result != PLANAR:
        raise PluginError(f"the law policy needs a model with an output of 2 numbers; this gives {found.result}")
    if (action := about.get(ACTION, ACTIONS[0])) not in ACTIONS:
        raise PluginError(
            f"the law policy cannot use its file: its metadata have {ACTION} = {action!r}; take one of "
            f"{', '.join(ACTIONS)}"
        )
    default = Observation()
    own, each = about.get(OBSERVES, " ".join(default.own)), about.get(EACH, " ".join(default.each))
    try:
        return Observation.sized(own, each, found.size), found
    except PluginError as error:
        raise PluginError(f"the law policy cannot use its file: {error}") from None


@lru_cache(maxsize=8)
def load_trigger(model: str) -> LearnedModel:
    """A learned trigger; raises PluginError as `read`, or for a model that does not fit."""
    found = read(model, "trigger policy")
    if (found.size, found.result, found.memory) != (JUDGED, 1, 0):
        raise PluginError(
            f"the trigger policy needs a model of {JUDGED} inputs (deviation, time since the last event, error) and "
            f"one output; this has {found.size} and {found.result}"
        )
    return found


def read(model: str, what: str) -> LearnedModel:
    """Model of a file, in base64; `what` it is for stands in errors.

    Raises PluginError without onnxruntime, or for a file that is none, or has other inputs and outputs than one of
    each, and with a memory two.
    """
    try:
        import numpy as np  # noqa: PLC0415 - comes with the extra
        import onnxruntime as ort  # noqa: PLC0415 - an extra
    except ImportError:
        raise PluginError(
            f"the {what} needs an extra library: ./zenpark install onnxruntime, or pip install -e '.[policy]'"
        ) from None
    if not model:
        raise PluginError(f"the {what} has no model: give `file`, an ONNX file beside the experiment file")
    options = ort.SessionOptions()
    options.intra_op_num_threads = options.inter_op_num_threads = 1  # the same order of sums everywhere
    options.log_severity_level = 4
    try:
        session = ort.InferenceSession(b64decode(model), options, providers=["CPUExecutionProvider"])
    except Exception as error:  # noqa: BLE001 - its own exceptions have no common base
        if "External data" in str(error):
            raise PluginError(
                f"the {what} needs a file with its weights, and this has them in a second one, as PyTorch writes it "
                "since 2.9; export it with external_data=False"
            ) from None
        raise PluginError(f"the {what} cannot use its file: {str(error).splitlines()[0]}") from None
    takes, gives = session.get_inputs(), session.get_outputs()
    plain = len(takes) == len(gives) and len(takes) in (1, 2) and all(map(_is_row, takes))
    if not plain or any(each.type != FLOAT for each in gives):
        raise _unfit(what, takes, gives)
    size, memory = takes[0].shape[-1], takes[1].shape[-1] if len(takes) == 2 else 0
    ends = [(each.name, [1] * (len(each.shape) - 1) + [each.shape[-1]]) for each in takes]

    def act(inputs: Sequence[float], memory: Values) -> tuple[Values, Values]:
        given = zip(ends, (inputs, memory), strict=False)
        feed = {name: np.array(numbers, dtype=np.float32).reshape(shape) for (name, shape), numbers in given}
        found, *state = (tuple(each.ravel().tolist()) for each in session.run(None, feed))
        return found, state[0] if state else ()

    try:  # outputs may have other sizes than they declare: networks of scikit-learn declare one number (skl2onnx 1.20)
        found, state = act((0.0,) * size, (0.0,) * memory)
    except Exception as error:  # noqa: BLE001 - as above
        raise PluginError(f"the {what} cannot use its file: {str(error).splitlines()[0]}") from None
    if len(state) != memory:
        raise _unfit(what, takes, gives)
    return LearnedModel(size, len(found), memory, session.get_modelmeta().custom_metadata_map, act)


def _unfit(what: str, takes: Sequence[Any], gives: Sequence[Any]) -> PluginError:
    """Error of a model with these inputs and outputs."""
    shapes = "; ".join(f"{each.name}: {each.type} {each.shape}" for each in (*takes, *gives))
    return PluginError(
        f"the {what} needs a model of one float input and one float output, and with a memory of a second one of "
        f"each, both of one size; this has {shapes}"
    )


def _is_row(end: Any) -> bool:  # noqa: ANN401 - of onnxruntime
    """Whether an input is one row of numbers, of a known length."""
    *rows, last = end.shape or [None]
    single = all(not isinstance(each, int) or each == 1 for each in rows)
    return end.type == FLOAT and single and isinstance(last, int) and last > 0


def _bounded(value: float) -> float:
    if value != value:  # noqa: PLR0124 - NaN
        return 0.0
    return value if isfinite(value) else MOST
