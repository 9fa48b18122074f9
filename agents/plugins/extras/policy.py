"""Learned policies; their runtime, onnxruntime, is the extra `policy`, and loads with numpy at first use."""

from __future__ import annotations

from base64 import b64decode
from collections.abc import Callable, Iterable, Mapping, Sequence
from functools import lru_cache
from math import isfinite, nan
from typing import Annotated, Any, ClassVar, Final

from msgspec import Meta

from zenpark import Control, Law, Measure, Memory, PluginError, RobotFacts, Severity, View

OWN: Final = 4  # numbers of a robot's own motion in an observation
EACH: Final = 4  # numbers of each neighbour
PLANAR: Final = 2  # numbers of an action

Act = Callable[[Sequence[float]], tuple[float, float]]


class Policy(Law, frozen=True):
    """v_i = π(o_i): a policy that was learned elsewhere, from a file in the ONNX format.

    π takes one observation of 4 + 4n numbers, float32: own x, y [m] and v_x, v_y [m/s]; then for each of n neighbours,
    by their numbers among the robots, p̂_j − p_i and the wanted p_j − p_i of the link, x and y each [m]. What is unknown
    or not there is 0. π gives v_x, v_y [m/s]. What it guarantees is up to its author: avoidance and setpoint filter
    have the last word.
    """

    PREDICTION: ClassVar[str] = "constant-velocity"
    MEASURES: ClassVar[Mapping[str, Measure]] = {
        "wanted_x": Measure("m/s", better=""),
        "wanted_y": Measure("m/s", better=""),
    }
    LIBRARY: ClassVar[str] = "onnxruntime"
    FILES: ClassVar[Mapping[str, str]] = {"file": "model"}

    file: Annotated[str, Meta(description="ONNX file beside the experiment file: its name")] = ""
    model: Annotated[str, Meta(description="content of that file, in base64: it goes with the experiment")] = ""

    def begin(self, robot: RobotFacts) -> Memory:
        """Nothing is remembered; raises PluginError for a model that cannot be used."""
        load(self.model)
        return {}

    def step(self, view: View, memory: Memory) -> Control:
        """Action for what is observed now."""
        places, act = load(self.model)
        x, y = act(observe(view, places))
        return Control(velocity=(x, y, nan), measures={"wanted_x": x, "wanted_y": y})

    def analyse(self, plan: Any) -> Iterable[tuple[Severity, str, str]]:  # noqa: ANN401 - as its base
        """Robots with more neighbours than the policy has places for."""
        places, _ = load(self.model)
        for name in plan.experiment.robots:
            if (count := len(plan.assignment(name).neighbours)) > places:
                message = f"{name} has {count} neighbours, and the policy observes {places}: the last ones are left out"
                yield "warning", message, "take fewer links, or a policy with more inputs"


def observe(view: View, places: int) -> list[float]:
    """Observation of the first n neighbours: 4 + 4 n numbers."""
    (x, y, _), found = view.position, [*view.position[:2], *view.velocity[:2]]
    for each in view.neighbours[:places]:
        wanted_x, wanted_y, _ = each.link.relative
        found += [each.position[0] - x, each.position[1] - y, -wanted_x, -wanted_y]
    found += [0.0] * (OWN + EACH * places - len(found))
    return [each if isfinite(each) else 0.0 for each in found]


@lru_cache(maxsize=8)
def load(model: str) -> tuple[int, Act]:
    """Neighbours that a policy observes, and its function; kept, since it is the same for all robots.

    Raises PluginError without onnxruntime, or for a model of other inputs and outputs.
    """
    try:
        import numpy as np  # noqa: PLC0415 - comes with the extra
        import onnxruntime as ort  # noqa: PLC0415 - an extra
    except ImportError:
        raise PluginError(
            "the law policy needs an extra library: ./zenpark install onnxruntime, or pip install -e '.[policy]'"
        ) from None
    if not model:
        raise PluginError("the law policy has no model: give `file`, an ONNX file beside the experiment file")
    options = ort.SessionOptions()
    options.intra_op_num_threads = options.inter_op_num_threads = 1  # the same order of sums everywhere
    options.log_severity_level = 4
    try:
        session = ort.InferenceSession(b64decode(model), options, providers=["CPUExecutionProvider"])
    except Exception as error:  # noqa: BLE001 - its own exceptions have no common base
        raise PluginError(f"the law policy cannot use its file: {str(error).splitlines()[0]}") from None
    takes, gives = session.get_inputs(), session.get_outputs()
    size, result = (sizes[-1] if (sizes := each[0].shape) else 0 for each in (takes, gives))
    alone = len(takes) == len(gives) == 1 and all(
        each.type == "tensor(float)" and all(not isinstance(n, int) or n == 1 for n in each.shape[:-1])
        for each in (*takes, *gives)
    )
    if not (alone and isinstance(size, int) and size >= OWN and (size - OWN) % EACH == 0 and result == PLANAR):
        shapes = "; ".join(f"{each.name}: {each.type} {each.shape}" for each in (*takes, *gives))
        raise PluginError(
            f"the law policy needs a model of one float input of 4 + 4n numbers and one float output of 2; this has "
            f"{shapes}"
        )
    name, shape = takes[0].name, [1] * (len(takes[0].shape) - 1) + [size]

    def act(observation: Sequence[float]) -> tuple[float, float]:
        (found,) = session.run(None, {name: np.array(observation, dtype=np.float32).reshape(shape)})
        x, y = found.ravel().tolist()
        return x, y

    return (size - OWN) // EACH, act
