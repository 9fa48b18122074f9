"""Results of a check: findings with severity, code, message and remedy at a place of the file, and figures."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, replace
from typing import Final, Literal

import msgspec

from experiments.file.problems import Path

Severity = Literal["error", "warning", "remark", "note"]

SHOWN_FINDINGS: Final = 5  # findings of one sort; the others are counted
NOT_RANDOM: Final = "not-random"  # code of the warning that no seed changes anything
DEVICE: Final = "device"  # code of what bodies say of the devices of their robots
FORGIVEN: Final = 1e-6  # allowance for rounding
APART: Final = "drives-apart"  # code of a law that drives robots apart
DELAYED: Final = 1.2  # times the acquisition without noise, from which on the one with noise is given as well
MARK: Final[dict[Severity, str]] = {"error": "✗", "warning": "!", "remark": "·", "note": "✓"}


@dataclass(frozen=True)
class Finding:
    """Finding on an experiment.

    Attributes:
        severity: Error: it cannot work; warning: it may not do what was meant; remark: what it costs; note: good news.
        code: One word for programs (docs/check.md).
        message: What it is, with numbers.
        remedy: What to change; empty for notes.
        where: Path in the file; of those that `check` returns file:line:column, or the `--set` at fault; empty for all.
    """

    severity: Severity
    code: str
    message: str
    remedy: str = ""
    where: Path | str = ""

    def __str__(self) -> str:
        """Line for a terminal."""
        return f"{MARK[self.severity]} {self.message}" + (f"; {self.remedy}" if self.remedy else "")


class CheckNumbers(msgspec.Struct, frozen=True, kw_only=True):
    """Figures of one case; None where one has no meaning, as without links."""

    robots: int  # how many
    arena: tuple[float, float, float]  # its size, x, y, z [m]
    obstacles: dict[str, str]  # what each is, by name
    links: int  # directed ones
    edges: int  # pairs that are linked, directions ignored
    parts: int  # components of the network
    leaders: tuple[str, ...]  # names
    algebraic_connectivity: float  # second eigenvalue of the network without directions
    rank: int | None  # rank of the rigidity matrix when heights are held, `rank_needed` for a rigid formation
    rank_needed: int | None  # see `rank`
    rank_space: int | None  # the same in full space
    rank_space_needed: int | None  # see `rank_space`
    # square of the smallest singular value of the rigidity matrix when heights are held, rigid motions left out [m²]
    smallest_eigenvalue: float | None
    spare_links: int | None  # pairs without any one of which the formation stays rigid; None where that has no meaning
    vital_links: tuple[str, ...]  # the other pairs
    spare_robots: int | None  # robots without any one of which it stays rigid
    vital_robots: tuple[str, ...]  # the other robots
    residual_mm: float | None  # worst link of the best shape
    loop_gain: float | None  # h·μ·λ_max; the loop is unstable from 2
    slowest_mode_s: float | None  # time constant of the slowest mode that moves
    remembers: bool  # the law has a memory, so that neither of the two is known
    free_modes: int  # modes that are slower than the run: nothing brings them back in time
    speed_needed: float | None  # speed of the fastest plan [m/s]
    speed_available: float | None  # speed of the slowest follower [m/s]
    acquired_s: float | None  # time from which the formation keeps within the tolerance, before any plan begins
    acquired_noisy_s: float | None  # the same, with the noise of the file's seed; None without such a flight as well
    end_error_mm: float | None  # worst link at the end
    end: dict[str, tuple[float, float, float]]  # expected place of each robot at the end [m]
    end_inside: bool  # whether all of them are inside the arena then
    messages_hz: float  # poses that all robots send in a second, estimated
    pose_bytes: int  # payload of one pose, its numbers at their longest
    words_bytes: int  # share of these bytes that the law says
    pose_kbit_s: float  # payload of one robot at the largest rate of its trigger [kbit/s]
    predicted_s: float  # share of the run that was predicted


def first_of_each_code(findings: Iterable[Finding]) -> list[Finding]:
    """First findings of each code; the last of them ends with the number of the others."""
    by_code: dict[str, list[Finding]] = {}
    for each in findings:
        by_code.setdefault(each.code, []).append(each)
    kept = []
    for same in by_code.values():
        kept += same[:SHOWN_FINDINGS]
        if len(same) > SHOWN_FINDINGS:
            kept[-1] = replace(kept[-1], message=f"{kept[-1].message}; and {len(same) - SHOWN_FINDINGS} more like this")
    return kept
