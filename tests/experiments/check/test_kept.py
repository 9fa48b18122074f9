"""Verdicts of earlier checks: the same as a new one, and none once anything has changed."""

from pathlib import Path
from types import SimpleNamespace
from unittest.mock import Mock

import pytest

from experiments.check import kept
from experiments.check.kept import KeptVerdict, Verdict
from tests.cases import mostly_slow
from tests.commands import zenpark
from tests.tools.test_cli import loaded

GOOD = Verdict("park.toml", "A park", [], None)
SITE = "site/mine-1.0.dist-info"
FILES = {
    "lab/park.toml": 'title = "A park"\nformation.law = { kind = "policy", file = "mine.onnx" }\n',
    "lab/hall.toml": "[arena]\nsize = [4.0, 4.0, 2.5]\n",
    "lab/mine.onnx": "one",
    "site/mine/__init__.py": "GAIN = 1\n",
    f"{SITE}/METADATA": "Name: mine\nVersion: 1.0\n",
    f"{SITE}/entry_points.txt": "[zenpark.laws]\nmine = mine:Law\n",
}


@pytest.fixture
def park(tmp_path, monkeypatch):
    """An experiment file beside an arena file, and a distribution with a plug-in, in a process of known code."""
    monkeypatch.setenv("ZENPARK_CACHE_DIR", str(tmp_path / "cache"))
    monkeypatch.setattr(kept, "uncovered_modules", lambda: iter(()))
    monkeypatch.setattr(kept.version, "digest", SimpleNamespace(__wrapped__=lambda: "this code"))
    monkeypatch.syspath_prepend(str(tmp_path / "site"))
    for name, text in FILES.items():
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / name).write_text(text)
    return tmp_path / "lab" / "park.toml"


def append(root, name):
    (root / name).parent.mkdir(exist_ok=True)
    with (root / name).open("a") as file:
        file.write("\nother = mine:Other\n")


CHANGED = ("lab/park.toml", "lab/hall.toml", "lab/mine.onnx", "site/mine/__init__.py", f"{SITE}/entry_points.txt")
INSTALLED = (f"site/{name}.dist-info/METADATA" for name in ("mine-1.1", "numpy-9.9"))
NEW = ("lab/gate.arena.toml", "site/cflib/x.py", *INSTALLED)


def test_verdict_is_read_again(park, tmp_path):
    assert KeptVerdict(str(park)).read() is None
    KeptVerdict(str(park)).keep(GOOD)
    assert KeptVerdict(str(park)).read() == GOOD
    (tmp_path / "site" / "runs").mkdir()
    assert KeptVerdict(str(park)).read() == GOOD
    for name in ("nowhere.toml", "a\0b", ".", "x" * 5000):  # no file
        KeptVerdict(name).keep(GOOD)
        assert KeptVerdict(name).read() is None


def test_verdicts_of_changes_or_too_old_go(park, tmp_path):
    for changed in ("site/mine/__init__.py", "lab/park.toml"):  # during the check
        begun = KeptVerdict(str(park))
        append(tmp_path, changed)
        begun.keep(GOOD)
    assert begun.read() is None
    assert not (tmp_path / "cache").exists()
    for seed in range(4):
        KeptVerdict(str(park), [f"seed={seed}"]).keep(GOOD, most=3)
    assert len(list((tmp_path / "cache" / "check").iterdir())) == 3
    assert KeptVerdict(str(park), ["seed=2"]).read() == GOOD


@pytest.mark.parametrize("name", mostly_slow([*CHANGED, *NEW], 4))
def test_nothing_that_changes_keeps_its_verdict(park, tmp_path, name):
    KeptVerdict(str(park)).keep(GOOD)
    append(tmp_path, name)
    assert KeptVerdict(str(park)).read() is None


def test_options_and_code_have_verdicts_of_their_own(park, monkeypatch):
    KeptVerdict(str(park), ["seed=2"], ["event"]).keep(GOOD)
    for options in ((), (["seed=3"], ["event"]), (["seed=2"], []), (["seed=2", "event"],), (["event"], ["seed=2"])):
        assert KeptVerdict(str(park), *options).read() is None
    assert KeptVerdict(str(park), ["seed=2"], ["event"]).read() == GOOD
    monkeypatch.setattr(kept.version, "digest", SimpleNamespace(__wrapped__=lambda: "another"))
    assert KeptVerdict(str(park), ["seed=2"], ["event"]).read() is None


def test_uncovered_code_keeps_nothing(tmp_path, monkeypatch):
    monkeypatch.setenv("ZENPARK_CACHE_DIR", str(tmp_path))
    KeptVerdict("triangle").keep(GOOD)  # these tests are such code
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize(
    "spoil",
    [
        lambda file: file.write_bytes(file.read_bytes()[:-3]),
        lambda file: file.write_bytes(file.read_bytes().replace(b"A park", b"A bark")),
        lambda file: file.write_bytes(b"\xff" * 100),
        lambda file: (file.unlink(), file.mkdir()),
        lambda file: file.parent.chmod(0o777),
    ],
)
def test_spoilt_cache_is_none(park, tmp_path, spoil):
    KeptVerdict(str(park)).keep(GOOD)
    (file,) = (tmp_path / "cache" / "check").iterdir()
    spoil(file)
    assert KeptVerdict(str(park)).read() is None
    KeptVerdict(str(park)).keep(GOOD)


def test_cache_that_cannot_be_written_is_none(park, tmp_path, monkeypatch):
    (tmp_path / "cache").write_text("a file")
    for _ in range(2):
        KeptVerdict(str(park)).keep(GOOD)
        assert KeptVerdict(str(park)).read() is None
        monkeypatch.delenv("ZENPARK_CACHE_DIR", raising=False)
        monkeypatch.delenv("XDG_CACHE_HOME", raising=False)
        monkeypatch.setattr(Path, "home", Mock(side_effect=RuntimeError))


@pytest.mark.slow
def test_second_check_says_the_same_without_numpy(tmp_path):
    file = tmp_path / "mine.toml"
    zenpark("new", "triangle", file)
    words = ["check", str(file), "--set", "duration_s=2.0"]
    heavy = {"numpy", "matplotlib", "zenoh", "pydantic"}
    first, modules = loaded(*words, ZENPARK_CACHE_DIR=str(tmp_path))
    assert heavy & modules == {"numpy"}
    second, modules = loaded(*words, ZENPARK_CACHE_DIR=str(tmp_path))
    assert (second, heavy & modules) == (first, set())
