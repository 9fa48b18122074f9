"""The lessons of docs/tutorials: what they claim is true, and they open as notebooks."""

import ast
import re

import pytest

from tests.commands import ROOT, python

FOLDER = ROOT / "docs" / "tutorials"
FIGURES = {
    "consensus": ["consensus-motions", "consensus-rates", "consensus-spectra", "consensus-steps"],
    "rigidity": ["rigidity-frameworks", "rigidity-heights", "rigidity-squares"],
    "events": ["events-intervals", "events-pareto", "events-raster"],
}
LEAST = {"consensus": 20, "rigidity": 40, "events": 25}  # assertions


def cells(lesson):
    """Markdown and code cells, in order."""
    text = (FOLDER / f"{lesson}.py").read_text("utf-8")
    assert text.startswith("# %%")
    parts = re.split(r"^# %%( \[markdown\])?\n", text, flags=re.MULTILINE)[1:]
    return [(bool(mark), body) for mark, body in zip(parts[::2], parts[1::2], strict=True)]


def test_every_lesson_is_known():
    assert sorted(FIGURES) == sorted(path.stem for path in FOLDER.glob("*.py"))


@pytest.mark.parametrize("lesson", FIGURES)
def test_a_lesson_is_a_notebook(lesson):
    found = cells(lesson)
    words = [body for is_text, body in found if is_text]
    code = [body for is_text, body in found if not is_text]
    assert all(line.startswith("#") for body in words for line in body.strip().splitlines())
    assert words[0].startswith("# # ")
    trees = [ast.parse(body) for body in code]  # each cell stands alone
    named = {node.id for tree in trees for node in ast.walk(tree) if isinstance(node, ast.Name)}
    assert "__file__" not in named  # notebooks have none
    assert sum(isinstance(node, ast.Assert) for tree in trees for node in ast.walk(tree)) >= LEAST[lesson]
    assert "# ## Exercises" in words[-1]
    for tree in trees:
        imports = [node for node in ast.walk(tree) if isinstance(node, ast.Import | ast.ImportFrom)]
        exec(compile(ast.Module(imports, []), lesson, "exec"), {})


@pytest.mark.nightly
@pytest.mark.timeout(300)
@pytest.mark.parametrize("lesson", FIGURES)
def test_what_a_lesson_claims_is_true(lesson, tmp_path):
    done = python("-W", "error", FOLDER / f"{lesson}.py", tmp_path / "figures", cwd=tmp_path, timeout_s=280.0)
    assert done.stderr == ""
    drawn = sorted(path.stem for path in (tmp_path / "figures").glob("*.svg"))
    assert drawn == FIGURES[lesson]
    for name in drawn:
        svg = (tmp_path / "figures" / f"{name}.svg").read_text("utf-8")
        assert svg.count("<path") > 20
        assert "NaN" not in svg
        assert len((tmp_path / "figures" / f"{name}.pdf").read_bytes()) > 5_000
