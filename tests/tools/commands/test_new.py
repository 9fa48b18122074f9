"""`./zenpark new` with a formation, and `./zenpark import`, as they are typed."""

import pytest
from typer.testing import CliRunner

from experiments.file import document
from experiments.file.problems import DocumentError
from tests.experiments.robotic_park_files import dome
from tools.main import app


def typed(tmp_path, monkeypatch, *words):
    monkeypatch.chdir(tmp_path)
    return CliRunner().invoke(app, list(words))


@pytest.mark.parametrize(
    ("words", "file", "robots"),
    [
        (["--hemisphere", "40"], "hemisphere-40.toml", 40),
        (["--polygon", "5", "--kind", "khepera4", "mine.toml"], "mine.toml", 5),
        (["--grid", "2x3", "--spacing", "0.8"], "grid-2x3.toml", 6),
        (["--polygon", "9", "--scatter", "0", "--duration", "12"], "polygon-9.toml", 9),
    ],
)
def test_formations(tmp_path, monkeypatch, words, file, robots):
    result = typed(tmp_path, monkeypatch, "new", *words)
    assert result.exit_code == 0, result.output
    assert f"zenpark check {file}" in result.output
    read = document.read(tmp_path / file)
    assert len(read.experiment.robots) == robots
    if "--duration" in words:
        assert (read.experiment.duration_s, read.experiment.start.scatter) == (12.0, 0.0)


@pytest.mark.parametrize(
    ("words", "said"),
    [
        ([], "--hemisphere 40"),
        (["--polygon", "5", "--grid", "2x2"], "--grid is too much"),
        (["--polygon", "5", "a.toml", "b.toml"], "'b.toml' is too much"),
    ],
)
def test_one_formation_at_a_time(tmp_path, monkeypatch, words, said):
    result = typed(tmp_path, monkeypatch, "new", *words)
    assert result.exit_code == 2
    assert said in result.output
    assert list(tmp_path.iterdir()) == []


def test_a_ready_made_one_is_copied_as_before(tmp_path, monkeypatch):
    assert typed(tmp_path, monkeypatch, "new", "triangle").exit_code == 0
    assert document.read(tmp_path / "triangle.toml").experiment.robots


def test_import(tmp_path, monkeypatch):
    (tmp_path / "five.yaml").write_text(dome(5))
    result = typed(tmp_path, monkeypatch, "import", "five.yaml", "--duration", "30")
    assert result.exit_code == 0, result.output
    assert "Not carried over" in result.output
    assert document.read(tmp_path / "five.toml").experiment.duration_s == 30.0
    broken = typed(tmp_path, monkeypatch, "import", "six.yaml")
    assert isinstance(broken.exception, DocumentError)  # which the command line turns into exit code 2
