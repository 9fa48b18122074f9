"""Verdicts of earlier checks, kept in the user's cache folder: an unchanged experiment need not be flown again.

A verdict holds only while all its inputs are the same to the letter. These are the experiment file and the TOML files
beside it, `--set` and the cases, the code of zenpark and of every plug-in, and the installed packages.
"""

from __future__ import annotations

import hashlib
import os
import platform
import stat
import sys
import sysconfig
from collections.abc import Iterator, Sequence
from contextlib import suppress
from importlib.metadata import EntryPoint, entry_points
from importlib.util import find_spec
from pathlib import Path
from typing import Any, Final

import msgspec

from agents.user_folder import cache_folder
from experiments.catalogue import index
from experiments.check.findings import DEVICE, CheckNumbers, Finding
from experiments.recording import version

MAX_VERDICTS: Final = 200  # verdicts that are kept
MOST_FILES: Final = 200  # beside an experiment, and in the catalogue, that are read
MAX_VERDICT_BYTES: Final = 4_000_000  # [bytes] largest such file
UNCOUNTED: Final = ("__pycache__", "runs")  # names made in a folder of modules by Python, or by a run
OTHERS: Final = 0o022  # mode of a folder in which others may write


class Verdict(msgspec.Struct, frozen=True):
    """Kept results of a check of an experiment."""

    path: str  # place of its file
    title: str
    findings: list[Finding]
    figures: dict[str, CheckNumbers] | None  # figures by case; None where they were not asked for


class KeptVerdict:
    """The verdict of an earlier check on an experiment; made before its file is read.

    Code and files are looked at here, and again before a verdict is used or kept: one that changes meanwhile has none.
    """

    def __init__(self, file: str, changes: Sequence[str] = (), cases: Sequence[str] = ()) -> None:
        self._file = index.find_file(file)
        self._asked = [str(self._file), *changes], list(cases)
        self._texts, self._code = self._read_texts(), _code()

    def read(self) -> Verdict | None:
        """The verdict; None if there is none, or it cannot be trusted."""
        place = self._place()
        if place is None:
            return None
        try:
            about = place.parent.stat()
            seal, _, content = place.read_bytes().partition(b"\n")
            if about.st_uid != os.getuid() or stat.S_IMODE(about.st_mode) & OTHERS or seal != _seal(content):
                return None
            return msgspec.json.decode(content, type=Verdict)
        except (OSError, msgspec.MsgspecError):
            return None

    def keep(self, verdict: Verdict, most: int = MAX_VERDICTS) -> None:
        """Keeps a verdict for the next check, and the newest `most` in all; nothing where that would not be safe."""
        place = self._place()
        if place is None or _code() != self._code or any(uncovered_modules()):
            return
        if any((each.code, each.severity) == (DEVICE, "error") for each in verdict.findings):
            return  # the file may lie anywhere
        with suppress(OSError, ValueError):
            content = msgspec.json.encode(verdict, enc_hook=_plain)
            place.parent.mkdir(mode=stat.S_IRWXU, parents=True, exist_ok=True)
            part = place.with_suffix(f".{os.getpid()}")
            part.write_bytes(_seal(content) + b"\n" + content)
            part.replace(place)
            for old in sorted(place.parent.iterdir(), key=lambda each: each.stat().st_mtime_ns)[:-most]:
                old.unlink()

    def _place(self) -> Path | None:
        """File of the verdict; None if an input cannot be read, or a text has changed."""
        if self._texts is None or self._code is None or self._read_texts() != self._texts:
            return None
        key = repr((self._asked, self._texts, self._code)).encode("utf-8", "backslashreplace")
        try:
            return cache_folder() / "check" / f"{hashlib.sha256(key).hexdigest()}.json"
        except RuntimeError:
            return None

    def _read_texts(self) -> list[tuple[str, str]] | None:
        """Name and digest of the experiment file, of what may be its arena file, and of what it names beside it.

        None if one cannot be read.
        """
        try:
            named = self._file.read_bytes() + repr(self._asked).encode()
            files = [self._file]
            for folder in (self._file.parent, index.FOLDER):
                inside = sorted(folder.iterdir())
                files += [each for each in inside if each.suffix.lower() == ".toml" or each.name.encode() in named]
            if len(files) > MOST_FILES or any(each.stat().st_size > MAX_VERDICT_BYTES for each in files):
                return None
            return [(str(each), _digest(each)) for each in files if each == self._file or each.is_file()]
        except (OSError, ValueError):
            return None


def _code() -> list[object] | None:
    """All that may decide: Python, our modules, what can be imported, and the packages of plug-ins of others.

    None if something of it cannot be read.
    """
    try:
        places = [(path, sorted(_importable(path))) for path in sys.path]
        packages = [(str(file), _digest(file)) for root in _foreign_roots() for file in _files(root)]
        plugins = sorted((each.group, each.name, each.value) for each in _plugins())
        return [sys.version, platform.machine(), version.digest.__wrapped__(), places, plugins, packages]
    except OSError:
        return None


def _plugins() -> Iterator[EntryPoint]:
    found = entry_points()
    for group in found.groups:
        if group.startswith("zenpark."):
            yield from found.select(group=group)


def _importable(path: str) -> Iterator[tuple[str, int]]:
    """Names in a folder of modules; of distributions, named with their version, also the time of installation [ns]."""
    with suppress(OSError), os.scandir(path or ".") as entries:
        for each in entries:
            if not each.name.startswith(".") and each.name not in UNCOUNTED:
                yield each.name, each.stat().st_mtime_ns if each.name.endswith(".dist-info") else 0


def _foreign_roots() -> Iterator[Path]:
    """Packages, or modules, in which the plug-ins of other distributions stand."""
    modules = {each.value.partition(":")[0].partition(".")[0].strip() for each in _plugins()}
    for name in sorted(modules - {*version.PACKAGES}):
        with suppress(ImportError, ValueError):  # registered, and gone
            if spec := find_spec(name):
                yield from map(Path, spec.submodule_search_locations or [spec.origin or ""])


def _files(root: Path) -> list[Path]:
    if root.is_file():
        return [root]
    return sorted(file for file in root.rglob("*") if file.is_file() and "__pycache__" not in file.parts)


def uncovered_modules() -> Iterator[Path]:
    """Modules of this process that nothing in `_code` stands for: what changes in them would go unseen."""
    paths = sysconfig.get_paths()
    known = [Path(paths[name]) for name in ("stdlib", "platstdlib", "purelib", "platlib")]
    known += [*(version.ROOT / name for name in version.PACKAGES), *_foreign_roots()]
    for name, module in list(sys.modules.items()):
        file = getattr(module, "__file__", None)
        if name != "__main__" and file and not any(Path(file).is_relative_to(each) for each in known):
            yield Path(file)


def _digest(file: Path) -> str:
    return hashlib.sha256(file.read_bytes()).hexdigest()


def _seal(content: bytes) -> bytes:
    return hashlib.sha256(content).hexdigest().encode()


def _plain(value: Any) -> Any:  # noqa: ANN401 - a number of numpy
    return value.item()
