"""The trigger of the documentation, installed from outside of this repository."""

import json
import os
import re
import subprocess
import sys
import tomllib
from pathlib import Path

import numpy as np
import pytest

from agents.formation.graph import Links

ROOT = Path(__file__).parents[3]


def installed(folder):
    """The example as an installer would leave it: its module, and what its distribution registers."""
    text = (ROOT / "docs" / "plugins.md").read_text(encoding="utf-8")
    (source,) = [block for block in re.findall(r"```python\n(.*?)```", text, re.DOTALL) if "SendEvery" in block]
    (project,) = [block for block in re.findall(r"```toml\n(.*?)```", text, re.DOTALL) if "my-triggers" in block]
    about = tomllib.loads(project)["project"]
    assert len(source.splitlines()) <= 20
    (folder / "my_triggers.py").write_text(source, encoding="utf-8")
    told = folder / f"my_triggers-{about['version']}.dist-info"
    told.mkdir()
    (told / "METADATA").write_text(f"Metadata-Version: 2.1\nName: {about['name']}\nVersion: {about['version']}\n")
    lines = [
        f"[{group}]\n" + "".join(f"{k} = {v}\n" for k, v in made.items())
        for group, made in about["entry-points"].items()
    ]
    (told / "entry_points.txt").write_text("\n".join(lines))


def zenpark(folder, *arguments):
    path = os.pathsep.join([str(folder), str(ROOT)])
    return subprocess.run(
        [sys.executable, "-m", "tools.guard", *arguments],
        cwd=folder, env={**os.environ, "PYTHONPATH": path}, capture_output=True, text=True, timeout=60, check=False,
    )  # fmt: skip


@pytest.mark.slow
def test_the_trigger_of_the_docs_runs_from_outside(tmp_path):
    installed(tmp_path)
    assert re.search(r"Triggers: .*\bsend-every\b", zenpark(tmp_path, "list").stdout)
    choice = 'cases.event.trigger={ kind = "send-every", metres = 0.02, maximum_silence_s = 5.0 }'
    run = zenpark(tmp_path, "run", "triangle", "--virtual", "--json", "--set", "duration_s=5", "--set", choice)
    assert run.returncode == 0, run.stderr
    cases = json.loads(run.stdout)["cases"]
    assert 0.0 < cases["event"]["mean"]["f_hz"] < 0.1 * cases["periodic"]["mean"]["f_hz"]
    wrong = zenpark(tmp_path, "run", "triangle", "--virtual", "--set", choice.replace("metres", "meters"))
    assert wrong.returncode != 0
    assert "did you mean 'metres'?" in wrong.stderr


def test_the_law_of_the_docs_pulls_to_the_distance_of_the_link():
    text = (ROOT / "docs" / "plugins.md").read_text(encoding="utf-8")
    (source,) = [block for block in re.findall(r"```python\n(.*?)```", text, re.DOTALL) if "Spring" in block]
    names: dict[str, type] = {"__name__": "my_laws"}
    exec(source, names)
    law = names["Spring"](constant=0.3)
    links = Links(np.array([0]), np.array([1]), np.array([0.5]), np.array([1.0]))
    position, heard = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, 0.0]]), np.array([[0.0, 0.0, 0.0]])
    assert law.offset(position, heard, links) == pytest.approx(np.array([[-0.15, 0.0, 0.0], [0.0, 0.0, 0.0]]))
    assert law.error(position, heard, links) == pytest.approx([0.5])
