"""The folder of a run: its place and name, the copy of its experiment file, its origin; and runs as a collection."""

from __future__ import annotations

import itertools
import shutil
import tomllib
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from datetime import datetime
from pathlib import Path
from typing import Annotated, Any, Final

import msgspec

from agents.errors import replacing
from experiments.file.arena_file import KEPT
from experiments.file.document import Document
from experiments.file.problems import refusal
from experiments.recording.version import Provenance

RUNS: Final = Path("runs")
SOURCE: Final = KEPT
ORIGIN: Final = "run.json"
METRICS: Final = "metrics.json"
SWEEP: Final = "sweep.json"  # name in the folder of a sweep instead
LATEST: Final = 1e11  # [s] UTC that a date can be made of


class RunOrigin(msgspec.Struct, frozen=True, omit_defaults=True):
    """Origin of a run, in `run.json` of its folder: enough to do it again."""

    command: str = ""  # how to do the run again, for people
    date: str = ""  # date for people
    title: str = ""  # title of the experiment
    file: str = ""  # experiment file, or name in the catalogue, as it was given
    virtual: bool = False  # True in virtual time
    cases: list[str] = []  # cases that were chosen; empty: all
    changes: list[str] = []  # values of `--set` and `--seed`
    seeds: Annotated[int, msgspec.Meta(ge=1, le=100_000)] = 1  # number of seeds, from that of the file on
    bodies: str | None = None  # value of `--bodies`
    here: bool = False  # all robots on this machine
    anyway: bool = False  # True although the check found errors
    tags: list[str] = []  # words by which people find it again
    begun: float = 0.0  # [s] UTC
    ended: float | None = None  # [s] UTC; None while it goes on, or if it was killed
    load_after: float | None = None  # see `Provenance.load`
    made_by: Provenance | None = None  # code, versions and machine
    failures: list[str] = []  # failures that its recordings do not tell, each with its case in front


def read_origin(folder: Path) -> RunOrigin | None:
    """Origin of the run in a folder; None if the folder has none, or another file of that name."""
    try:
        return msgspec.json.decode((folder / ORIGIN).read_bytes(), type=RunOrigin)
    except (OSError, ValueError, RecursionError):
        return None


def keep_origin(folder: Path, origin: RunOrigin) -> None:
    """Write the origin of a run into its folder; the former stays if there is no room."""
    with replacing(folder / ORIGIN) as fresh:
        fresh.write_bytes(msgspec.json.format(msgspec.json.encode(origin), indent=2) + b"\n")


@contextmanager
def naming(folder: Path) -> Iterator[None]:
    """Inside, errors of writing name a place: the system names none where a disk is full."""
    try:
        yield
    except OSError as error:
        error.filename = error.filename or str(folder)
        raise


def check_folder(out: str | None) -> None:
    """Refuse a folder for a run that cannot be used, before anything is made; raises DocumentError."""
    if out is None:
        return
    try:
        taken = any(Path(out).iterdir())
    except FileNotFoundError:
        return
    except NotADirectoryError:
        raise refusal(
            out, "is a file, and the results of a run need a folder", "name a new folder with --out"
        ) from None
    except OSError as error:
        raise refusal(out, f"cannot be read: {error.strerror}", "name a new folder with --out") from None
    if taken:
        raise refusal(out, "holds something already", "name a new folder with --out")


def new_folder(read: Document, out: str | None, what: str = "") -> Path:
    """Makes the folder of a run: `out`, or one below `runs` with experiment and time in its name, and `what`, if given.

    Raises DocumentError if it holds something already, or cannot be made.
    """
    folder = RUNS if out is None else Path(out)
    try:
        folder.mkdir(parents=True, exist_ok=True)
        if out is None:
            return _folder_of_now(folder, "-".join(part for part in (read.path.stem, what) if part))
    except OSError as error:
        hint = "choose a place that may be written to with --out"
        raise refusal(str(folder), f"cannot be made: {error.strerror}", hint) from None
    check_folder(out)
    return folder


def _folder_of_now(runs: Path, name: str) -> Path:
    """Makes a folder of its own, however many runs begin in the same second."""
    stamp = datetime.now().astimezone().strftime("%Y-%m-%dT%H-%M-%S")
    for number in itertools.count(1):
        folder = runs / (f"{name}-{stamp}" if number == 1 else f"{name}-{stamp}-{number}")
        with suppress(FileExistsError):
            folder.mkdir()
            return folder
    raise AssertionError


def remove_unused(folder: Path) -> None:
    """Removes the folder of a run without a recording, without figures and without a process's log."""
    if not any(any(folder.glob(kept)) for kept in ("*.mcap", "logs/*", METRICS)):
        shutil.rmtree(folder, ignore_errors=True)


class PastRun(msgspec.Struct, frozen=True):
    """A run that is over, as its folder tells."""

    folder: str
    origin: RunOrigin
    made: float  # [s] UTC
    megabytes: float  # size of all files
    recorded: bool  # whether it has a recording
    seeds: list[int]
    cases: dict[str, dict[str, dict[int, float | None]]]  # metrics of each case, by seed; None: not known
    # of each case and seed notes for a reader of its figures: share of its time, disturbances
    remarks: dict[str, dict[int, str]] = {}
    lengths: dict[str, dict[int, float]] = {}  # lengths of each case by seed [s]; unknown of another version
    lost: int = 0  # poses that were sent and never received, of all cases
    fault: str = ""  # why figures are missing, and the remedy

    def matches(self, words: Sequence[str]) -> bool:
        """Whether each word is one of its tags, or stands in its folder's name, its title or a case, in any case."""
        text = " ".join([Path(self.folder).name, self.origin.title, self.origin.file, *self.cases]).lower()
        tags = {tag.lower() for tag in self.origin.tags}
        return all(word.lower() in tags or word.lower() in text for word in words)


def past_runs(folders: Sequence[Path]) -> list[PastRun]:
    """The runs in some folders, and one level below them, the oldest first; folders of no run are passed over."""
    places = [place for folder in folders for place in (folder, *_subfolders(folder))]
    found = [run for place in dict.fromkeys(places) if (run := _past_run(place)) is not None]
    return sorted(found, key=lambda run: run.made)


def _subfolders(folder: Path) -> list[Path]:
    try:
        return sorted(place for place in folder.iterdir() if place.is_dir() and not place.is_symlink())
    except OSError:
        return []


def _past_run(folder: Path) -> PastRun | None:
    """The run in a folder; None without the files that every run leaves."""
    source = folder / SOURCE
    if not source.is_file():
        return None
    origin = read_origin(folder) or RunOrigin()
    cases = case_figures(folder / METRICS)
    recorded = any(folder.glob("*.mcap"))
    if not (recorded or cases or origin.begun):
        return None
    figures: dict[str, dict[str, dict[int, float | None]]] = {}
    remarks: dict[str, dict[int, str]] = {}
    lengths: dict[str, dict[int, float]] = {}
    for each in cases:
        lengths.setdefault(each.case, {})[each.seed] = each.duration_s
        if each.remark:
            remarks.setdefault(each.case, {})[each.seed] = each.remark
    for case in dict.fromkeys(each.case for each in cases):
        means = {each.seed: each.mean for each in cases if each.case == case}
        names = dict.fromkeys(name for mean in means.values() for name in mean)
        figures[case] = {name: {seed: mean.get(name) for seed, mean in means.items()} for name in names}
    seeds = sorted({each.seed for each in cases})
    try:
        made = origin.begun if 0.0 < origin.begun < LATEST else source.stat().st_mtime
    except OSError:  # removed meanwhile
        return None
    megabytes, lost = 1e-6 * _size(folder), sum(each.lost for each in cases)
    damaged = not cases and (folder / METRICS).is_file()
    fault = f"{METRICS} cannot be read: `./zenpark report {folder}` makes it again" if damaged else ""
    return PastRun(str(folder), origin, made, megabytes, recorded, seeds, figures, remarks, lengths, lost, fault)


def _size(folder: Path) -> int:
    """Size of all files in a folder [bytes], without what links lead to."""
    size = 0
    for file in folder.rglob("*"):
        with suppress(OSError):  # removed meanwhile
            size += file.lstat().st_size if file.is_file() else 0
    return size


class CaseFigures(msgspec.Struct, frozen=True):
    """The figures of a case with one seed: means over its robots, by index."""

    case: str
    seed: int
    mean: dict[str, float | None]
    duration_s: float = 0.0  # [s]; 0 in those of another version
    planned_s: float = 0.0  # [s]
    interrupted: bool = False
    lost: int = 0  # poses
    spoiled: tuple[str, ...] = ()
    failures: tuple[str, ...] = ()

    @property
    def remark(self) -> str:
        """Warning beside the figures of the run; empty: none."""
        early = [f"{self.duration_s:.1f} s of {self.planned_s:g} s"] if self.interrupted else []
        return "; ".join([*early, *self.spoiled])


def case_figures(file: Path) -> list[CaseFigures]:
    """The figures in `metrics.json` of any version, in order; empty if it holds none."""
    try:
        return msgspec.json.decode(file.read_bytes(), type=list[CaseFigures])
    except (OSError, ValueError, RecursionError):
        return []


def differences(first: PastRun, other: PastRun) -> list[str]:
    """Differences of a run from another one in file, options, seeds, code and versions."""
    before, after = (dict(flattened(_document(Path(run.folder)))) for run in (first, other))
    found = [
        f"{key} {_formatted(before.get(key))} → {_formatted(after.get(key))}"
        for key in dict.fromkeys([*before, *after])
        if before.get(key) != after.get(key)
    ]
    for name in ("virtual", "bodies", "changes", "cases"):
        old, new = getattr(first.origin, name), getattr(other.origin, name)
        if old != new:
            found.append(f"{name}: {_formatted(old)} → {_formatted(new)}")
    if first.seeds != other.seeds:
        found.append(f"seeds: {_formatted(first.seeds)} → {_formatted(other.seeds)}")
    old_code, new_code = first.origin.made_by, other.origin.made_by
    if old_code is not None and new_code is not None:
        found += [f"made with {each}" for each in new_code.differences(old_code)]
    return found


def _document(folder: Path) -> Any:  # noqa: ANN401 - whatever stands there
    try:
        text = (folder / SOURCE).read_text("utf-8")
        return msgspec.json.decode(text) if text.lstrip().startswith("{") else tomllib.loads(text)
    except (OSError, ValueError, RecursionError):
        return {}


def flattened(value: Any, path: str = "") -> Iterator[tuple[str, Any]]:  # noqa: ANN401 - a document
    """The values in a document with their paths; lists of values count as one."""
    if isinstance(value, dict) and value:
        for key, each in value.items():
            yield from flattened(each, f"{path}.{key}" if path else str(key))
    elif isinstance(value, list) and any(isinstance(each, dict) for each in value):
        for number, each in enumerate(value):
            yield from flattened(each, f"{path}[{number}]")
    else:
        yield path, value


def _formatted(value: object) -> str:
    if value in (None, [], {}):
        return "-"
    return ", ".join(map(str, value)) if isinstance(value, list) else str(value)


def differences_from_first(labels: Sequence[str], folders: Sequence[str]) -> list[tuple[str, str, list[str]]]:
    """Label and folder of each run, and how it differs from the first one; of those that keep their file."""
    past = {run.folder: run for run in past_runs([Path(folder) for folder in folders])}
    known = [(name, past[str(Path(folder))]) for name, folder in zip(labels, folders, strict=True)
             if str(Path(folder)) in past]  # fmt: skip
    return [(name, run.folder, differences(known[0][1], run)) for name, run in known]
