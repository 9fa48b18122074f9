"""A law of a notebook flies in real time: in processes that have not seen the notebook, by a file beside the run."""

import json
from pathlib import Path

import pytest

from experiments.file.problems import DocumentError
from experiments.run import fly, reopen
from tests.commands import python
from tests.small import COUNTING_LAW
from zenpark import load

NOTEBOOK = f"""
from zenpark import fly, load, simulate

GAIN = 0.25
{COUNTING_LAW}

if __name__ == "__main__":
    read = load("two.toml", law=Counting(stiffness=GAIN))
    print(simulate(read).metrics["default"].mean["rmse"], fly(read, folder="flown").metrics["default"].mean["rmse"])
"""
FILE = """
title = "One keeps an offset"
duration_s = 5.0
robots.A = { kind = "khepera4", start = [0.0, 0.0] }
robots.B = { kind = "khepera4", start = [-0.6, 0.5] }
formation.links = { "A > B" = { offset = [-0.4, 0.3] } }
disturbance.all.position_sigma = 0.0003
"""


@pytest.mark.system
def test_law_of_a_notebook_flies_in_real_time(tmp_path):
    (tmp_path / "two.toml").write_text(FILE, "utf-8")
    (tmp_path / "notebook.py").write_text(NOTEBOOK, "utf-8")
    said = python("notebook.py", cwd=tmp_path).stdout
    kept = tmp_path / "flown" / "counting.py"
    assert said.startswith(f"{Path('flown', 'counting.py')}: ")
    assert "class Counting(Law, frozen=True):" in kept.read_text("utf-8")
    simulated, flown = map(float, said.split()[-2:])
    assert flown == pytest.approx(simulated, rel=0.1)
    again = reopen(tmp_path / "flown").metrics["default"]
    assert (again.clock, again.mean["rmse"], again.failures) == ("real", flown, ())
    assert again.measures["push"].unit == "m"
    origin = json.loads((tmp_path / "flown" / "run.json").read_text("utf-8"))
    assert origin["changes"] == ['formation.law={"kind" = "counting.py:Counting", "stiffness" = 0.25}']
    repeated = load(tmp_path / "flown" / "experiment.toml", *origin["changes"])
    assert repeated.experiment.formation.law["stiffness"] == 0.25


def test_real_robots_are_not_for_a_notebook(tmp_path):
    for change, said in (
        ('robots.CF01.body="radio://0/80/2M/E7E7E7E701"', "real robots and other machines are not for a notebook"),
        ("formation.gain=40", "unstable"),
    ):
        with pytest.raises(DocumentError, match=said):
            fly(load("triangle", change), folder=tmp_path / "never")
    assert not (tmp_path / "never").exists()
