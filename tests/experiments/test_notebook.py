import sys
from types import ModuleType

import pytest
from matplotlib.figure import Figure

from experiments.check import check
from experiments.file import document
from experiments.file.document import loads
from experiments.file.problems import DocumentError
from experiments.run import CHECKOUT, folder, show, simulate

TEXT = """title = "Two"
duration_s = 4.0
[robots]
KH01 = { kind = "khepera4", start = [-0.5, 0.0] }
KH02 = { kind = "khepera4", start = [0.5, 0.0] }
[formation.links]
"KH01 - KH02" = 0.8
"""


def drawn():
    figure = Figure(figsize=(1.0, 1.0))
    figure.subplots().plot([0.0, 1.0])
    return figure


def test_a_figure_shows_itself_and_is_kept(tmp_path):
    picture = show(drawn(), tmp_path / "deep" / "line")
    assert picture.files == (tmp_path / "deep" / "line.svg", tmp_path / "deep" / "line.pdf")
    assert picture.files[0].read_text("utf-8") == picture._repr_svg_()
    assert picture._repr_svg_().startswith("<?xml")
    assert picture.files[1].read_bytes().startswith(b"%PDF")
    assert show(drawn()).files == ()


def test_the_folder_is_an_argument_but_not_that_of_a_kernel(monkeypatch, tmp_path):
    monkeypatch.setattr(sys, "argv", ["lesson.py"])
    assert folder("docs/out") == CHECKOUT / "docs" / "out"
    monkeypatch.setattr(sys, "argv", ["lesson.py", str(tmp_path)])
    assert folder("docs/out") == tmp_path
    monkeypatch.setattr(sys, "argv", ["kernel", "-f", "kernel.json"])
    monkeypatch.setitem(sys.modules, "ipykernel", ModuleType("ipykernel"))
    assert folder("docs/out") == CHECKOUT / "docs" / "out"


def test_an_experiment_may_be_text():
    read = loads(TEXT, "formation.gain=2.0")
    assert read.experiment.formation.gain == 2.0
    assert list(read.experiment.robots) == ["KH01", "KH02"]
    trace = simulate(read).traces["default"]
    gap = abs(trace.true_position[-1, 0, 0] - trace.true_position[-1, 1, 0])
    assert gap == pytest.approx(0.8, abs=0.05)
    (first, *_) = check.check(loads(TEXT.replace("4.0", "0.2")))
    assert first.where == "text:2:14"
    assert str(first).startswith("! the formation is not acquired in time")
    assert str(first).endswith(f"; {first.remedy}")


def test_what_is_wrong_with_a_text_has_a_place():
    with pytest.raises(DocumentError) as refused:
        loads(TEXT.replace("khepera4", "kephera4", 1))
    (problem,) = refused.value.problems
    assert (problem.file, problem.line) == (document.TEXT, 4)
    with pytest.raises(DocumentError, match="is empty"):
        loads("  \n")
