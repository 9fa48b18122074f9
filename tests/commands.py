"""Commands of zenpark as tests call them: in this process, in a process of their own, or many in one shell."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import psutil
from click.testing import Result
from typer.testing import CliRunner

from tools.main import app

ROOT = Path(__file__).resolve().parents[1]
GUARD = ("-m", "tools.guard")  # what `./zenpark` runs


def environment(**more: str) -> dict[str, str]:
    """Variables of this process as they are now, with zenpark on the import path, and `more`."""
    return {**os.environ, "PYTHONPATH": str(ROOT), **more}


def invoke(*words: object, code: int | None = 0) -> Result:
    """Result of a command in this process: `exit_code`, `stdout`, `output` with errors, `exception`.

    Errors that `tools.main.main` explains, with exit code 2, end here in `exception`; `zenpark` below shows their text.

    Args:
        words: What is typed after `./zenpark`.
        code: Exit code that is asserted; None: any.
    """
    done = CliRunner().invoke(app, [str(word) for word in words])
    assert code in (None, done.exit_code), (done.output, done.exception)
    return done


def python(
    *words: object, code: int | None = 0, timeout_s: float = 240.0, **options: Any
) -> subprocess.CompletedProcess[str]:
    """Python process, run to its end: `returncode`, `stdout`, `stderr`.

    Args:
        words: Arguments of Python.
        code: Exit code that is asserted; None: any.
        options: As those of `subprocess.run`: `cwd` (the checkout), `env` (`environment()`), ...
    """
    given = {"cwd": ROOT, "env": environment(), "stdin": subprocess.DEVNULL, "capture_output": True, "text": True}
    command = [sys.executable, *map(str, words)]
    done = subprocess.run(command, check=False, timeout=timeout_s, **{**given, **options})
    assert code in (None, done.returncode), (done.stdout, done.stderr)
    return done


def zenpark(*words: object, code: int | None = 0, **options: Any) -> subprocess.CompletedProcess[str]:
    """Command in a process of its own, as `python`."""
    return python(*GUARD, *words, code=code, **options)


@contextmanager
def started(*words: object, **options: Any) -> Iterator[subprocess.Popen[str]]:
    """Python process that runs during the block, and is killed afterwards with its children.

    Args:
        words: Arguments of Python; `*GUARD, "run", ...` for a command.
        options: As those of `subprocess.Popen`; all streams are pipes of text.
    """
    streams = dict.fromkeys(("stdin", "stdout", "stderr"), subprocess.PIPE)
    given = {"cwd": ROOT, "env": environment(), "text": True, **streams}
    with subprocess.Popen([sys.executable, *map(str, words)], **{**given, **options}) as process:
        try:
            yield process
        finally:
            if process.poll() is None:
                for each in [*psutil.Process(process.pid).children(recursive=True), process]:
                    each.kill()


LOOP = """
import contextlib, io, json, sys, traceback
from tools.main import main

if __name__ == "__main__":
    answers, sys.stdout = sys.stdout, sys.stderr
    for line in sys.stdin:
        sys.argv, code = ["zenpark", *json.loads(line)], 0
        with contextlib.redirect_stdout(io.StringIO()) as out, contextlib.redirect_stderr(io.StringIO()) as err:
            try:
                main()
            except SystemExit as end:
                code = end.code or 0
            except BaseException:
                code = 1
                traceback.print_exc()
        print(json.dumps([code, out.getvalue(), err.getvalue()]), file=answers, flush=True)
"""


class Shell:
    """Commands one after the other in one process and folder; packages that lie there count as installed."""

    def __init__(self, process: subprocess.Popen[str]) -> None:
        self._process = process

    def __call__(self, *arguments: str) -> subprocess.CompletedProcess[str]:
        """Output and exit code of a command."""
        assert self._process.stdin is not None
        assert self._process.stdout is not None
        print(json.dumps(arguments), file=self._process.stdin, flush=True)
        code, out, err = json.loads(self._process.stdout.readline())
        return subprocess.CompletedProcess(arguments, code, out, err)


@contextmanager
def shell(folder: Path) -> Iterator[Shell]:
    path = os.pathsep.join([str(folder), str(ROOT)])
    with started("-c", LOOP, cwd=folder, env=environment(PYTHONPATH=path), stderr=None) as process:
        yield Shell(process)
