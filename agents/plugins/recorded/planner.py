"""Planner that follows the poses or polynomials of a file."""

from __future__ import annotations

from base64 import b64decode
from collections.abc import Mapping
from functools import lru_cache
from math import isfinite
from typing import Annotated, ClassVar, Final, Literal

from msgspec import Meta

from agents.plugins.planners import Planner
from agents.plugins.recorded.curves import Curve, Polynomials
from agents.plugins.recorded.formats import FormatError, read
from agents.vectors import NotNegative, Pose, Positive, Vector

JUMP: Final = 0.02  # pieces that are farther apart than this do not belong together [m]


class Recorded(Planner, frozen=True):
    """Poses over time from a file: CSV, TUM, exports of motion capture, polynomials of Crazyswarm; then stay."""

    FILES: ClassVar[Mapping[str, str]] = {"file": "content"}

    file: Annotated[str, Meta(min_length=1, description="file beside the experiment file: its name")]
    body: Annotated[str, Meta(description="object in a file with several: its name")] = ""
    up: Annotated[Literal["y", "z"], Meta(description="axis that points up in an export of Motive")] = "y"
    relative: Annotated[
        bool, Meta(description="from where the robot is when the leg begins; else places are those of the arena")
    ] = False
    stretch: Annotated[float, Meta(ge=0.01, le=100, description="multiple of its times: with 2 at half the speed")] = (
        1.0
    )
    from_s: Annotated[NotNegative, Meta(description="time in the file from which on it is followed [s]")] = 0.0
    until_s: Annotated[Positive | None, Meta(description="time in the file up to which; left out: its end [s]")] = None
    content: Annotated[
        str,
        Meta(
            description="content of that file, in base64: it goes with the experiment",
            examples=["dCx4LHkKMCwwLDAKMSwwLjMsMAo="],
        ),
    ] = ""

    def __post_init__(self) -> None:
        """Raises ValueError for a file that cannot be followed, with its line."""
        if not self.content:
            return  # its name is at fault, which is said there
        name = self.file
        try:
            curve = self._curve
        except FormatError as error:
            raise ValueError(f"{name}, {error}") from None
        if isinstance(curve, Polynomials):
            for line, way in curve.jumps:
                if way > JUMP:
                    hint = "a piece begins where the one before it ends"
                    raise ValueError(
                        f"{name}, line {line}: it begins {way:.2g} m from the end of the piece before; {hint}"
                    )
        if self.from_s >= self._end:
            hint = f"it lasts {curve.duration:.4g} s: begin earlier, or end later"
            raise ValueError(f"nothing of {name} lies between from_s and until_s; {hint}")

    @property
    def duration(self) -> float:
        """Duration of the leg [s]."""
        return self.stretch * (self._end - self.from_s)

    @property
    def _curve(self) -> Curve:
        return _curve(self.content, self.body, self.up)

    @property
    def _end(self) -> float:
        lasts = self._curve.duration
        return lasts if self.until_s is None else min(self.until_s, lasts)

    def target(self, elapsed: float, anchor: Vector, heading: float) -> Pose:
        x, y, z, yaw = self._pose(elapsed)
        if self.relative:
            from_x, from_y, from_z, _ = self._pose(0.0)
            x, y, z = anchor[0] + x - from_x, anchor[1] + y - from_y, anchor[2] + z - from_z
        return x, y, z if isfinite(z) else anchor[2], yaw

    def speed(self) -> float:
        return self._curve.speed / self.stretch

    def source(self, elapsed: float) -> str:
        """Place in the file of the target at a time, for people."""
        line = self._curve.line(self._time(elapsed))
        return f"{self.file}, line {line}"

    def _pose(self, elapsed: float) -> Pose:
        return self._curve.pose(self._time(elapsed))

    def _time(self, elapsed: float) -> float:
        return min(self.from_s + elapsed / self.stretch, self._end)


@lru_cache(maxsize=64)
def _curve(content: str, body: str, up: str) -> Curve:
    """The curve of a file, kept: each pose is asked for at every tick."""
    try:
        text = b64decode(content).decode("utf-8", errors="replace")
    except ValueError:
        raise FormatError("its content is no base64; leave it out, and name the file") from None
    return read(text, body, up)
