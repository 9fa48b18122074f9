"""Processes that compute what groups wrote: one for each robot of a flight, walled in, which answers questions.

`python -P -m experiments.course.cells SOCKET LIBRARY...` is a nursery: a fresh interpreter that has never seen the
course. It imports the libraries and forks a cell for each socket that it is sent. What a cell knows is thus what its
questions hold: no seed, no criterion, no other robot. Answers are data, never pickles.
"""

from __future__ import annotations

import os
import pickle
import signal
import socket
import sys
import sysconfig
from collections.abc import Mapping, Sequence
from contextlib import suppress
from importlib import import_module
from importlib.util import find_spec
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any, Final, NamedTuple, NoReturn

import msgspec

from agents.errors import ExplainedError
from agents.plugins import registry
from agents.plugins.calls import failure, supervised, wrong
from agents.plugins.law import Control
from agents.user_folder import cache_folder
from experiments.course.wall import wall_in

CALL_S: Final = 2.0  # [s] longest call, see `supervised`
LONGEST_WORDS: Final = 400  # characters of an error
FREE_SLOTS: Final = 1 << 16  # largest number of an open file


class Inmate(NamedTuple):
    """Plug-in that a cell computes."""

    group: str  # entry-point group
    choice: str  # class in a file, with the digest
    parameters: Mapping[str, Any] | None  # None: it is asked for no more than its class variables
    declares: Sequence[str]  # class variables that are asked for
    cpu_s: int  # computing time [s]
    memory: int  # memory beside that of the nursery [bytes]


def main() -> NoReturn:
    """Be a nursery until the socket ends: a file descriptor asks for a cell, a number for the exit code of one."""
    control = socket.socket(fileno=int(sys.argv[1]))
    for name in sys.argv[2:]:
        with suppress(Exception):  # an import in the law itself says why
            if _is_installed(name):
                import_module(name)
    codes: dict[int, int] = {}  # exit codes of cells by their numbers
    while True:
        asked, descriptors, _, _ = socket.recv_fds(control, 64, 1)
        if not asked:
            os._exit(0)
        if descriptors:
            answer = os.fork()
            if answer == 0:
                _live(descriptors[0])
            os.close(descriptors[0])
            codes.pop(answer, None)
        else:
            _reap(codes, int(asked))
            answer = codes[int(asked)]
        control.send(b"%d" % answer)
        _reap(codes)


def _reap(codes: dict[int, int], number: int = -1) -> None:
    """Wait for the end of a cell; without a number, note those that have ended."""
    with suppress(ChildProcessError):
        while number not in codes:
            ended, status = os.waitpid(number, os.WNOHANG if number < 0 else 0)
            if ended == 0:
                break
            codes[ended] = os.waitstatus_to_exitcode(status)


def _is_installed(name: str) -> bool:
    """Whether a module is of an installed library, which may be imported before the wall."""
    spec = find_spec(name.partition(".")[0])
    folders = (sysconfig.get_path("purelib"), sysconfig.get_path("platlib"))
    return spec is not None and any((spec.origin or "").startswith(f"{each}{os.sep}") for each in folders)


def _live(descriptor: int) -> NoReturn:
    """Be a cell, in a process that was forked for it, until its questions end."""
    end = os._exit
    try:
        os.closerange(3, descriptor)
        os.closerange(descriptor + 1, FREE_SLOTS)
        signal.signal(signal.SIGINT, signal.SIG_DFL)
        questions = Connection(descriptor)
        inmate = Inmate(*pickle.loads(questions.recv_bytes()))  # noqa: S301 - of the marking itself
        digest = inmate.choice.partition("@")[2]
        wall_in(inmate.cpu_s, inmate.memory, [Path(cache_folder()) / "plugins" / digest] if digest else [])
        with supervised(CALL_S):
            _answer(questions, inmate)
    except EOFError:
        end(0)
    finally:
        end(1)


def _answer(questions: Connection, inmate: Inmate) -> None:
    """Answer questions, each a method with its arguments: with [result], or with the words of an error."""
    what = {registry.LAWS: "law", registry.TRIGGERS: "trigger"}[inmate.group]
    plugin: Any = None
    try:
        kind = registry.struct(inmate.group, inmate.choice)
        said: object = [{name: getattr(kind, name) for name in inmate.declares}]
        if inmate.parameters is not None:
            plugin = msgspec.convert(inmate.parameters, kind)
    except BaseException as error:  # noqa: BLE001 - whatever a group wrote
        said = _words(error)
    while True:
        try:
            message = msgspec.msgpack.encode(said, enc_hook=_plain)
        except BaseException as error:  # noqa: BLE001 - likewise
            message = msgspec.msgpack.encode(f"the {what} gives what cannot be used: {_words(error)}")
        questions.send_bytes(message)
        method, arguments = pickle.loads(questions.recv_bytes())  # noqa: S301 - likewise
        try:
            said = [_asked(what, plugin, method, arguments)]
        except ExplainedError as error:
            said = _words(error)
        except BaseException as error:  # noqa: BLE001 - likewise
            said = _words(failure(what, plugin, error))


def _asked(what: str, plugin: Any, method: str, arguments: Sequence[Any]) -> object:  # noqa: ANN401 - a plug-in
    result = getattr(plugin, method)(*arguments)
    if method == "step" and not isinstance(result, Control):
        raise wrong(what, plugin, method, result, "a Control")
    return (result, vars(arguments[0].memory)) if method == "fires" else result


def _words(error: BaseException) -> str:
    text = str(error) if isinstance(error, ExplainedError) else f"{type(error).__name__}: {error}"
    return " ".join(text.split())[:LONGEST_WORDS]


def _plain(value: Any) -> object:  # noqa: ANN401 - a number or an array of numpy
    if isinstance(value, Mapping):
        return dict(value)
    return value.tolist() if hasattr(value, "tolist") else [*value]


if __name__ == "__main__":
    main()
