"""Provenance of results: digest of the code, versions, machine."""

from __future__ import annotations

import ctypes
import hashlib
import os
import platform
import shutil
import socket
import subprocess
from collections.abc import Sequence
from contextlib import suppress
from functools import cache
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Final

import msgspec

from agents.body.kinds import KINDS
from agents.plugins import registry

ROOT: Final = Path(__file__).resolve().parents[2]
PACKAGES: Final = ("agents", "bridges", "twins", "experiments", "tools")
DIGEST_CHARACTERS: Final = 8  # characters of a digest that people compare
# libraries, besides those of kinds, with versions that may change results, or bytes on a wire; those not installed are
# left out
LIBRARIES: Final = (
    "numpy", "eclipse-zenoh", "msgspec", "mcap", "pymunk", "mujoco", "mujoco-core", "daqp", "onnxruntime",
)  # fmt: skip
GIT_S: Final = 5.0
UNSYNCHRONISED: Final = 5  # return value of adjtimex for a clock that is not synchronised (TIME_ERROR)
TIMEX_BYTES: Final = 256  # more than struct timex has


class Provenance(msgspec.Struct, frozen=True, omit_defaults=True):
    """Code, versions and machine with which something was made."""

    zenpark: str  # version
    code: str  # digest of all modules, see `digest`
    python: str
    packages: dict[str, str]  # versions of `LIBRARIES` and of those of kinds
    commit: str = ""  # commit of a checkout; "+changes" behind it if files differ from it
    plugins: dict[str, str] = {}  # distributions with plug-ins, except our own, and their versions
    host: str = ""
    system: str = ""
    cpu: str = ""
    cores: int = 0
    memory_gb: float = 0.0
    load: float | None = None  # processes that wanted a core in the minute before
    clock: str = ""  # whether something keeps the clock right, and how well

    @property
    def words(self) -> tuple[str, ...]:
        """Code, versions and machine in a sentence each, for people."""
        code = f"zenpark {self.zenpark}, code {self.code[:DIGEST_CHARACTERS]}"
        if self.commit:
            changed = " with changes" if self.commit.endswith("+changes") else ""
            code += f", commit {self.commit[:DIGEST_CHARACTERS]}{changed}"
        used = [f"Python {self.python}", *(f"{name} {number}" for name, number in self.packages.items())]
        added = [f"plug-ins of {name} {number}" for name, number in self.plugins.items()]
        machine = [self.system, self.cpu, f"{self.cores} cores", f"{self.memory_gb:.0f} GB"]
        load = [] if self.load is None else [f"load {self.load:.1f} before"]
        clock = [f"clock {self.clock}"] if self.clock else []
        return code, ", ".join([*used, *added]), ", ".join([self.host, *filter(None, machine), *load, *clock])

    def differences(self, other: Provenance) -> list[str]:
        """Differences of code and versions, in words; machines differ without being named.

        A library that one of them did without cannot have mattered; a distribution with plug-ins can.
        """
        found = []
        if self.code != other.code:
            found.append(f"code {self.code[:DIGEST_CHARACTERS]}, not {other.code[:DIGEST_CHARACTERS]}")
        left, right = ({"Python": each.python, **each.packages, **each.plugins} for each in (self, other))
        shared = sorted(left.keys() & right.keys())
        found += [f"{name} {left[name]}, not {right[name]}" for name in shared if left[name] != right[name]]
        found += [f"plug-ins of {name} {left[name]}, the other without" for name in sorted({*self.plugins} - {*right})]
        lacking = sorted({*other.plugins} - {*left})
        return found + [f"no plug-ins of {name}, the other with version {right[name]}" for name in lacking]


@cache
def digest(root: Path = ROOT, packages: Sequence[str] = PACKAGES) -> str:
    """SHA-256 over names and contents of all modules of some packages, in hexadecimal; other files are not code."""
    total = hashlib.sha256()
    for file in sorted(file for name in packages for file in (root / name).rglob("*.py")):
        content = file.read_bytes()
        total.update(f"{file.relative_to(root).as_posix()}\0{len(content)}\0".encode() + content)
    return total.hexdigest()


@cache
def file_digest(file: Path) -> str:
    return hashlib.sha256(file.read_bytes()).hexdigest()


def provenance(text: str | None = None) -> Provenance:
    """Code, versions and machine of this process, now; of plug-ins only those that the text of an experiment names."""
    libraries = dict.fromkeys([*LIBRARIES, *(kind.library for kind in KINDS.usable() if kind.library)])
    packages = {name: found for name in libraries if (found := installed(name)) is not None}
    memory = 0.0
    with suppress(OSError, ValueError):
        memory = os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES") / 1e9
    return Provenance(
        zenpark=installed("zenpark") or "unknown",
        code=digest(),
        python=platform.python_version(),
        packages=packages,
        commit=_commit(),
        plugins=registry.distributions(text),
        host=socket.gethostname(),
        system=f"{platform.system()} {platform.release()} {platform.machine()}",
        cpu=_cpu(),
        cores=os.cpu_count() or 0,
        memory_gb=round(memory, 1),
        load=load(),
        clock=clock_quality(),
    )


def load() -> float | None:
    """Processes that wanted a core in the last minute, on average; None where the system does not tell."""
    try:
        return round(os.getloadavg()[0], 2)
    except (AttributeError, OSError):
        return None


def clock_quality() -> str:
    """Whether a time service keeps the clock right, and within what, by the kernel; empty where it does not tell."""
    try:
        adjtimex = ctypes.CDLL(None, use_errno=True).adjtimex
    except (AttributeError, OSError):
        return ""
    timex = (ctypes.c_long * (TIMEX_BYTES // ctypes.sizeof(ctypes.c_long)))()  # modes, offset, freq, maxerror [µs], ...
    state = adjtimex(ctypes.byref(timex))
    if state < 0:
        return ""
    return "not synchronised" if state == UNSYNCHRONISED else f"synchronised within {timex[3] / 1e3:.1f} ms"


def installed(package: str) -> str | None:
    """The installed version of a package."""
    try:
        return version(package)
    except PackageNotFoundError:
        return None


def engine_versions(engine: str) -> list[str]:
    """Installed distributions of the library that has the name of an engine, each with its version."""
    names = (engine, f"{engine}-core")  # MuJoCo's engine without its viewer is a distribution of its own
    return [f"{name} {found}" for name in names if (found := installed(name)) is not None]


@cache
def _commit() -> str:
    """Commit of the checkout, with "+changes" if files differ from it; empty without git."""
    if not (ROOT / ".git").exists() or shutil.which("git") is None:
        return ""
    try:
        head, changed = (
            subprocess.run(
                ["git", "-C", str(ROOT), *words], capture_output=True, text=True, check=True, timeout=GIT_S
            ).stdout.strip()
            for words in (["rev-parse", "HEAD"], ["status", "--porcelain", "--untracked-files=no"])
        )
    except (OSError, subprocess.SubprocessError):
        return ""
    return head + ("+changes" if changed else "")


@cache
def _cpu() -> str:
    """Name of the processor; that of its architecture where the system does not tell."""
    with suppress(OSError):
        for line in Path("/proc/cpuinfo").read_text("utf-8", "replace").splitlines():
            name, _, value = line.partition(":")
            if name.strip() in ("model name", "Model"):
                return value.strip()
    return platform.processor()
