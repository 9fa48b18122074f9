"""Plug-ins in a Python file beside an experiment: `"pursuit.py:Pursuit"` instead of a name, without an installation.

The reader of the experiment file adopts the Python file: a copy goes into the user's cache under its digest, and the
choice becomes `pursuit.py:Pursuit@DIGEST`. Every process of that user on this machine loads that copy and no other. A
choice of another machine or of a recording is thus loaded only if its user has read such a file here.
"""

from __future__ import annotations

import importlib.util
import os
import re
import stat
import sys
from functools import cache
from pathlib import Path
from types import ModuleType
from typing import Any, Final

from agents.user_folder import OWN, cache_folder

CHOICE: Final = r"[^@:\\/][^@:\\]*\.py:[A-Za-z_][A-Za-z0-9_]*"  # class in a file, as a user writes it
PREFIX: Final = "zenpark_file_"  # first letters of the names of their modules
KEPT: Final = "plugins"  # folder of the copies, in the cache
MAX_FILE_BYTES: Final = 1_000_000  # [bytes] largest such file
_CHOICE: Final = re.compile(rf"({CHOICE})(?:@([0-9a-f]{{32}}))?")
_OTHERS: Final = 0o022  # mode of what others may write


def is_choice(name: str) -> bool:
    """Whether the name of a plug-in is a file with a class in it."""
    return _CHOICE.fullmatch(name) is not None


def plain(text: str) -> str:
    """A text with the names of plug-ins, and of their files, as their user has written them: without the copies."""
    text = re.sub(r"(\.py:\w+)@[0-9a-f]{32}", r"\1", text)
    return re.sub(rf"/(?:[^/\s]+/)*{KEPT}/[0-9a-f]{{32}}/", "", text)


def adopt(name: str, folder: Path) -> tuple[str, Path]:
    """Keeps a copy of the file of a choice.

    Args:
        folder: In which, or in a folder of which, the file lies.

    Returns:
        The choice with the digest of the file, and the copy.

    Raises:
        ValueError: If there is no such file, or it is not to be trusted; with a remedy behind `; `.
    """
    path, _, _ = name.partition(":")
    file = folder / path
    if ".." in file.relative_to(folder).parts:
        raise ValueError(f"{path!r} leads out of the folder of the experiment; put it beside the experiment file")
    if file.exists() and not file.is_file():  # a pipe would be waited for
        raise ValueError(f"{path} is no file; put the Python file beside the experiment file")
    try:
        with file.open("rb") as opened:
            about, text = os.fstat(opened.fileno()), opened.read(MAX_FILE_BYTES + 1)
    except OSError as error:
        known = ", ".join(sorted(each.name for each in folder.glob("*.py"))[:10]) or "none is there"
        raise ValueError(
            f"the file {file} cannot be read ({error.strerror}); files beside the experiment: {known}"
        ) from None
    if len(text) > MAX_FILE_BYTES:
        raise ValueError(f"{path} has more than {MAX_FILE_BYTES // 1000} kB; take a file with one plug-in")
    owners = {os.geteuid(), 0, Path(__file__).stat().st_uid}
    if about.st_uid not in owners or (about.st_mode & stat.S_IWOTH):
        raise ValueError(f"{path} is of another user, or others may write to it; copy it, and look at what it does")
    kept = _place(_digest(text), path)
    try:
        kept.parent.mkdir(mode=OWN, parents=True, exist_ok=True)
        if not kept.is_file() or kept.read_bytes() != text:
            part = kept.with_name(f"{os.getpid()}.new")
            part.write_bytes(text)
            part.replace(kept)
    except OSError as error:
        raise ValueError(f"{kept} cannot be written ({error.strerror}); name a cache with ZENPARK_CACHE_DIR") from None
    return f"{name}@{_digest(text)}", kept


def load(name: str) -> Any:  # noqa: ANN401 - a plug-in of any group
    """The class of a choice; raises ImportError if its file was not adopted here, or has no such class, and whatever
    the file raises."""
    choice, _, digest = name.partition("@")
    path, _, attribute = choice.partition(":")
    module = _module(_place(digest, path), digest)
    if not hasattr(module, attribute):
        classes = [each for each, value in vars(module).items() if getattr(value, "__module__", "") == module.__name__]
        raise ImportError(f"it has no {attribute}, only {', '.join(classes) or 'no class'}")
    return getattr(module, attribute)


@cache
def _module(kept: Path, digest: str) -> ModuleType:
    try:
        text, mode = kept.read_bytes(), kept.parent.stat()
    except OSError:
        text, mode = b"", None
    if mode is None or _digest(text) != digest or mode.st_uid != os.geteuid() or mode.st_mode & _OTHERS:
        raise ImportError("this user has not read it on this machine; `./zenpark check` on the file that names it does")
    name = f"{PREFIX}{digest}"
    spec = importlib.util.spec_from_file_location(name, kept)
    assert spec is not None
    assert spec.loader is not None
    module = sys.modules[name] = importlib.util.module_from_spec(spec)
    try:
        spec.loader.exec_module(module)
    except BaseException:
        del sys.modules[name]
        raise
    return module


def _place(digest: str, path: str) -> Path:
    return cache_folder() / KEPT / digest / Path(path).name


def _digest(text: bytes) -> str:
    import hashlib  # noqa: PLC0415 - 8 ms that a quick command does without

    return hashlib.sha256(text).hexdigest()[:32]
