"""Pages of the gallery: each law has a picture, drawn by a program that still runs."""

import runpy

from experiments.catalogue import index
from tests.commands import ROOT
from zenpark import load, simulate

FOLDER = ROOT / "docs" / "gallery"
DRAW = runpy.run_path(str(FOLDER / "draw.py"))
LAWS = {page.stem for page in FOLDER.glob("*.md")} - {"index"}


def test_every_page_has_a_light_picture():
    assert {*DRAW["SUBJECTS"]} == LAWS
    assert all(index.find_file(name).is_file() for name in LAWS)
    sizes = {name: (FOLDER / f"{name}.svg").stat().st_size for name in LAWS}
    assert {name: size for name, size in sizes.items() if size > 60_000} == {}
    first = (FOLDER / "index.md").read_text("utf-8")
    assert [name for name in LAWS if f"({name}.md)" not in first] == []


def test_figures_of_a_recorded_run_are_printed(tmp_path, capsys):
    simulate(load("consensus", "duration_s=2.0"), cases=["event"], folder=tmp_path)
    DRAW["main"](["--runs", str(tmp_path)])
    assert capsys.readouterr().out.startswith("consensus event: 1.")
