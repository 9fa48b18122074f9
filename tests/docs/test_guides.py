"""Guides do what they say: their files, commands and snippets are run in the order in which they stand."""

import re
import shlex
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

import pytest

from tests.commands import ROOT, invoke, zenpark

DOCS = ROOT / "docs"
SHORT = ("shadow-twin", "two-crazyflies", "motion-capture", "three-machines", "lab-certificates")
LONG = ("first-hour", "from-a-paper", "mixed-reality", "teaching")  # 10 to 30 s each
GUIDES = (*SHORT, *LONG)
STEP = re.compile(
    r"^```(?P<language>toml|python)\n(?P<block>(?s:.*?))^```|^ {4,}\./zenpark (?P<command>[^#\n]*)(?P<said>.*)",
    re.MULTILINE,
)
COMPUTING = {"lab", "check", "clean", "course", "explain", "export", "import", "new", "report", "sweep"}
REAL = (
    *("run way.toml", "run shadow.toml --out runs/shadow --open", "run measured.toml"),
    *("run two.toml --bodies protocol", "run three.toml --here"),
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
    if {"--view", "--open", "--video"} & set(words):
        return False
    return words[0] in COMPUTING or (words[0] == "run" and ("--virtual" in words or words[1].endswith(".zip")))


def shortened(words: list[str]) -> list[str]:
    """A command with two seeds or values instead of many; reports are made only by `report`."""
    few = [re.sub(r"^(seeds=|.*:(?:log|lin))\d+$", r"\g<1>2", each) for each in words]
    if "--seeds" in few:
        few[few.index("--seeds") + 1] = "2"
    return few + {"sweep": ["--processes", "1"], "run": ["--no-report"]}.get(few[0], [])


@pytest.mark.slow
@pytest.mark.parametrize("guide", [*SHORT, *(pytest.param(guide, marks=pytest.mark.nightly) for guide in LONG)])
def test_a_guide_can_be_followed(guide, hub, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("ZENPARK_RUNTIME_DIR", str(tmp_path / "runs"))
    Path("docs").symlink_to(DOCS)
    done = 0
    for step in steps(guide):
        if step.kind == "toml":
            Path(step.file).write_text(step.text, "utf-8")
        elif step.kind == "python" and "reopen" not in step.text:
            text = step.text.replace("tcp/127.0.0.1:7447", hub.endpoint)
            exec(compile(text, guide, "exec"), {"camera": lambda: [(0.1, 0.2, 0.0, 0.3, 1e9)]})
        elif step.kind == "command" and computes(words := shlex.split(step.text)):
            invoke(*shortened(words), code=step.code)
        else:
            continue
        done += 1
    assert done > 1


@pytest.mark.system
@pytest.mark.parametrize("command", REAL)
def test_a_guide_flies_in_real_time(command, tmp_path, monkeypatch):
    found = [step for guide in GUIDES for step in steps(guide)]
    assert Step("command", command) in found
    _, name, *options = (word for word in shlex.split(command.partition("--out")[0]))
    (text,) = [step.text for step in found if (step.kind, step.file) == ("toml", name)]
    file, out = tmp_path / name, tmp_path / "runs" / Path(name).stem
    file.write_text(text, "utf-8")
    done = zenpark("run", file, *options, "--no-report", "--out", out, timeout_s=120.0, code=None)
    assert done.returncode in {0, 3}, done.stdout  # 3: a busy machine has missed deadlines
    monkeypatch.chdir(tmp_path)
    for step in found:
        if step.kind == "python" and f'reopen("runs/{out.name}")' in step.text:
            exec(compile(step.text, command, "exec"), {})
