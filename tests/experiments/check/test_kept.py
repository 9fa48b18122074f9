"""Verdicts of earlier checks: the same as a new one, and none once anything has changed."""

import os
import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace

import pytest

from experiments.check import kept
from experiments.check.check import examine
from experiments.check.kept import KeptVerdict, Verdict
from experiments.file import document
from tests.tools.test_cli import loaded

SAID = Verdict("park.toml", "A park", [], None)
POINTS = "[zenpark.laws]\nmine = mine:Law\n"


@pytest.fixture
def park(tmp_path, monkeypatch):
    """An experiment file beside an arena file, and a distribution with a plug-in, in a process of known code."""
    monkeypatch.setenv("ZENPARK_CACHE_DIR", str(tmp_path / "cache"))
    monkeypatch.setattr(kept, "_strangers", lambda: iter(()))
    monkeypatch.syspath_prepend(str(tmp_path / "site"))
    (tmp_path / "site" / "mine").mkdir(parents=True)
    (tmp_path / "site" / "mine" / "__init__.py").write_text("GAIN = 1\n")
    (tmp_path / "site" / "mine-1.0.dist-info").mkdir()
    (tmp_path / "site" / "mine-1.0.dist-info" / "METADATA").write_text("Name: mine\nVersion: 1.0\n")
    (tmp_path / "site" / "mine-1.0.dist-info" / "entry_points.txt").write_text(POINTS)
    (tmp_path / "lab").mkdir()
    (tmp_path / "lab" / "hall.toml").write_text("[arena]\nsize = [4.0, 4.0, 2.5]\n")
    file = tmp_path / "lab" / "park.toml"
    (tmp_path / "lab" / "mine.onnx").write_bytes(b"one")
    file.write_text('title = "A park"\nformation.law = { kind = "policy", file = "mine.onnx" }\n')
    return file


def renamed(park):
    site = park.parents[1] / "site"
    (site / "mine-1.0.dist-info").rename(site / "mine-1.1.dist-info")


def appended(*parts):
    def change(park):
        with park.parents[1].joinpath(*parts).open("a") as file:
            file.write("\n# changed")

    return change


CHANGES = {
    "experiment file": appended("lab", "park.toml"),
    "arena file": appended("lab", "hall.toml"),
    "arena file that hides one of the catalogue": appended("lab", "gate.arena.toml"),
    "file of a law": lambda park: (park.parent / "mine.onnx").write_bytes(b"two"),
    "code of a plug-in": appended("site", "mine", "__init__.py"),
    "new body in a plug-in": appended("site", "mine", "body.py"),
    "version of a plug-in": renamed,
    "another plug-in": appended("site", "mine-1.0.dist-info", "entry_points.txt"),
    "installed library": lambda park: (park.parents[1] / "site" / "numpy-9.9.dist-info").mkdir(),
    "library without a distribution": lambda park: (park.parents[1] / "site" / "cflib").mkdir(),
}


def test_verdict_is_read_again(park):
    assert KeptVerdict(str(park)).read() is None
    KeptVerdict(str(park)).keep(SAID)
    assert KeptVerdict(str(park)).read() == SAID


@pytest.mark.parametrize("what", CHANGES)
def test_nothing_that_changes_keeps_its_verdict(park, what):
    KeptVerdict(str(park)).keep(SAID)
    if what == "another plug-in":
        info = park.parents[1] / "site" / "mine-1.0.dist-info" / "entry_points.txt"
        info.write_text(POINTS + "other = mine:Other\n")
    else:
        CHANGES[what](park)
    assert KeptVerdict(str(park)).read() is None


def test_folder_of_runs_changes_nothing(park):
    KeptVerdict(str(park)).keep(SAID)
    (park.parents[1] / "site" / "runs").mkdir()
    assert KeptVerdict(str(park)).read() == SAID


def test_options_and_code_have_verdicts_of_their_own(park, monkeypatch):
    KeptVerdict(str(park), ["seed=2"], ["event"]).keep(SAID)
    for options in ((), (["seed=3"], ["event"]), (["seed=2"], []), (["seed=2", "event"],), (["event"], ["seed=2"])):
        assert KeptVerdict(str(park), *options).read() is None
    assert KeptVerdict(str(park), ["seed=2"], ["event"]).read() == SAID
    monkeypatch.setattr(kept.version, "digest", SimpleNamespace(__wrapped__=lambda: "another"))
    assert KeptVerdict(str(park), ["seed=2"], ["event"]).read() is None


def test_change_during_a_check_keeps_nothing(park):
    begun = KeptVerdict(str(park))
    appended("site", "mine", "__init__.py")(park)
    begun.keep(SAID)
    again = KeptVerdict(str(park))
    appended("lab", "park.toml")(park)
    again.keep(SAID)
    assert again.read() is None
    assert not (park.parents[1] / "cache").exists()


def test_code_that_nothing_stands_for_keeps_nothing(tmp_path, monkeypatch):
    monkeypatch.setenv("ZENPARK_CACHE_DIR", str(tmp_path))
    KeptVerdict("triangle").keep(SAID)  # these tests are such code
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize(
    "spoil",
    [
        lambda file: file.write_bytes(file.read_bytes()[:-3]),
        lambda file: file.write_bytes(file.read_bytes().replace(b"A park", b"A bark")),
        lambda file: file.write_bytes(b"\xff" * 100),
        lambda file: file.write_bytes(b""),
        lambda file: (file.unlink(), file.mkdir()),
        lambda file: file.parent.chmod(0o777),
    ],
)
def test_spoilt_cache_is_none(park, spoil):
    KeptVerdict(str(park)).keep(SAID)
    (file,) = (park.parents[1] / "cache" / "check").iterdir()
    spoil(file)
    assert KeptVerdict(str(park)).read() is None
    KeptVerdict(str(park)).keep(SAID)


def test_cache_that_cannot_be_written_is_none(park, monkeypatch):
    (park.parents[1] / "cache").write_text("a file")
    KeptVerdict(str(park)).keep(SAID)
    assert KeptVerdict(str(park)).read() is None
    monkeypatch.delenv("ZENPARK_CACHE_DIR")
    monkeypatch.delenv("XDG_CACHE_HOME", raising=False)
    monkeypatch.setattr(Path, "home", lambda: (_ for _ in ()).throw(RuntimeError))
    KeptVerdict(str(park)).keep(SAID)
    assert KeptVerdict(str(park)).read() is None


@pytest.mark.parametrize("name", ["nowhere.toml", "a\0b", ".", "x" * 5000])
def test_what_is_no_file_has_no_verdict(park, name):
    KeptVerdict(name).keep(SAID)
    assert KeptVerdict(name).read() is None


def test_old_verdicts_go(park):
    for seed in range(13):
        KeptVerdict(str(park), [f"seed={seed}"]).keep(SAID, most=10)
    assert len(list((park.parents[1] / "cache" / "check").iterdir())) == 10
    assert KeptVerdict(str(park), ["seed=8"]).read() == SAID


@pytest.mark.slow
def test_findings_and_figures_come_back_as_they_were(park):
    given = document.read("triangle", ["duration_s=5.0"])
    new = Verdict(str(given.path), given.experiment.title, *examine(given))
    KeptVerdict(str(park)).keep(new)
    assert KeptVerdict(str(park)).read() == new


@pytest.mark.slow
def test_second_check_says_the_same_without_numpy(tmp_path):
    file = tmp_path / "mine.toml"
    subprocess.run([sys.executable, "-m", "tools.guard", "new", "triangle", file], check=True, env=os.environ)
    words = ["check", str(file), "--set", "duration_s=2.0"]
    first, modules = loaded(*words, ZENPARK_CACHE_DIR=str(tmp_path))
    assert "numpy" in modules
    assert not {"matplotlib", "zenoh", "pydantic"} & modules
    second, modules = loaded(*words, ZENPARK_CACHE_DIR=str(tmp_path))
    assert second == first
    assert not {"numpy", "matplotlib", "zenoh", "pydantic"} & modules
    file.write_text(file.read_text().replace('title = "', 'title = "Another '))
    third, modules = loaded(*words, ZENPARK_CACHE_DIR=str(tmp_path))
    assert "Another " in third
    assert "numpy" in modules
