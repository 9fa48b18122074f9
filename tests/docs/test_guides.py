"""Guides do what they say: their files, commands and snippets are run in the order in which they stand."""

from __future__ import annotations

import re
import shlex
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

import pytest

from tests.commands import ROOT, zenpark
from tools.main import main

DOCS = ROOT / "docs"
SHORT = ("shadow-twin", "two-crazyflies", "vicon", "three-machines", "lab-certificates")
LONG = ("first-hour", "from-a-paper", "mixed-reality", "teaching", "course/solutions/README")  # 10 to 30 s each
GUIDES = (*SHORT, *LONG)
STEP = re.compile(
    r"^```(?P<language>toml|python)\n(?P<block>(?s:.*?))^```|^ {4,}\./zenpark (?P<command>[^#\n]*)(?P<said>.*)",
    re.MULTILINE,
)
COMPUTING = {"lab", "check", "clean", "explain", "export", "import", "new", "report", "sweep"}
REAL = (
    "run way.toml",
    "run shadow.toml --out runs/shadow --open",
    "run two.toml --bodies protocol",
    "run measured.toml",
    "run three.toml --here",
)


class Step(NamedTuple):
    kind: str  # toml, python or command
    text: str
    file: str = ""  # that a block of TOML is
    code: int = 0  # exit code


def steps(guide: str) -> Iterator[Step]:
    """Files, commands and snippets of a guide, in order; the file of a block is the last one named before it."""
    text = (DOCS / f"{guide}.md").read_text("utf-8").replace("\\\n", " ")
    for found in STEP.finditer(text):
        if found["command"]:
            yield Step("command", found["command"].strip(), code=int("exit code 1" in found["said"]))
        elif found["language"] == "python" or "title = " in found["block"]:
            named = re.findall(r"[\w-]+\.toml", text[: found.start()])
            yield Step(found["language"], found["block"], named[-1] if named else "")


def computes(words: list[str]) -> bool:
    """Whether a command ends by itself, without robots in real time, a browser or a film."""
    if "--view" in words or "--open" in words or "--video" in words:
        return False
    return words[0] in COMPUTING or (words[0] == "run" and ("--virtual" in words or words[1].endswith(".zip")))


def call(words: list[str], monkeypatch: pytest.MonkeyPatch) -> object:
    """Exit code of a command; of many seeds or values two are run, and reports are made only by `report`."""
    few = [re.sub(r"^(seeds=|.*:(?:log|lin))\d+$", r"\g<1>2", each) for each in words]
    if "--seeds" in few:
        few[few.index("--seeds") + 1] = "2"
    more = {"sweep": ["--processes", "1"], "run": ["--no-report"]}.get(few[0], [])
    monkeypatch.setattr(sys, "argv", ["zenpark", *few, *more])
    with pytest.raises(SystemExit) as ended:
        main()
    return ended.value.code


@pytest.mark.slow
@pytest.mark.timeout(300)
@pytest.mark.parametrize("guide", [*SHORT, *(pytest.param(guide, marks=pytest.mark.nightly) for guide in LONG)])
def test_a_guide_can_be_followed(guide: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("ZENPARK_RUNTIME_DIR", str(tmp_path / "runs"))
    Path("docs").symlink_to(DOCS)
    done = 0
    for step in steps(guide):
        if step.kind == "toml":
            Path(step.file).write_text(step.text, "utf-8")
        elif step.kind == "python" and "reopen" not in step.text:
            exec(compile(step.text, guide, "exec"), {})
        elif step.kind == "command" and computes(words := shlex.split(step.text)):
            assert call(words, monkeypatch) == step.code, step.text
        else:
            continue
        done += 1
    assert done > 1


@pytest.mark.system
@pytest.mark.timeout(150)
@pytest.mark.parametrize("command", REAL)
def test_a_guide_flies_in_real_time(command: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    found = [step for guide in GUIDES for step in steps(guide)]
    assert Step("command", command) in found
    _, name, *options = (word for word in shlex.split(command.partition("--out")[0]))
    (text,) = [step.text for step in found if (step.kind, step.file) == ("toml", name)]
    file, out = tmp_path / name, tmp_path / "runs" / Path(name).stem
    file.write_text(text, "utf-8")
    zenpark("run", file, *options, "--no-report", "--out", out, timeout_s=120.0)
    monkeypatch.chdir(tmp_path)
    for step in found:
        if step.kind == "python" and f'reopen("runs/{out.name}")' in step.text:
            exec(compile(step.text, command, "exec"), {})
