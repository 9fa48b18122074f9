"""Consent before an experiment of others touches machines and devices."""

import os
from pathlib import Path
from types import SimpleNamespace

import pytest

from experiments.file.document import load, loads
from experiments.file.problems import DocumentError
from tools import consent

REACHING = """
title = "two"
duration_s = 5.0
positioning = "vicon://192.0.2.9:801"
[robots]
A = { kind = "crazyflie", start = [-0.4, 0.0], hover = 0.5, body = "radio://0/80/2M/E7E7E7E701" }
B = { kind = "khepera4", start = [0.4, 0.0] }
[formation.links]
"A - B" = 0.8
[hosts.pi]
address = "pi@192.0.2.7"
robots = ["B"]
"""


def asking(monkeypatch, answer):
    """A terminal in which the user answers; None: no terminal."""
    stdin = SimpleNamespace(isatty=lambda: answer is not None, readline=lambda: f"{answer}\n")
    monkeypatch.setattr("sys.stdin", stdin)
    monkeypatch.setattr("sys.stderr.isatty", lambda: True, raising=False)


def test_others_files_run_when_agreed(monkeypatch):
    cases = loads(REACHING).cases()
    device, machine, cameras = consent.touched(cases.values())
    assert "A: radio://0/80/2M/E7E7E7E701" in device
    assert "ssh pi@192.0.2.7" in machine
    assert cameras == "motion capture: vicon://192.0.2.9:801"
    for answer in ("y", "YES"):
        asking(monkeypatch, answer)
        consent.require("a.zip", cases, given=False)
    for answer in ("n", "", None):
        asking(monkeypatch, answer)
        consent.require("a.zip", load("robotic-park").cases(), given=False)  # it is simulated
        consent.require("a.zip", cases, given=True)
        with pytest.raises(DocumentError, match="--yes" if answer is None else "--here"):
            consent.require("a.zip", cases, given=False)


def test_own_files_are_no_strangers(tmp_path, monkeypatch):
    file = tmp_path / "own.toml"
    file.touch()
    assert not consent.belongs_to_another(file)
    assert not consent.belongs_to_another(tmp_path / "missing.toml")
    owner = SimpleNamespace(st_uid=os.geteuid() + 4321)
    monkeypatch.setattr(Path, "stat", lambda self, **_: owner if self == file else SimpleNamespace(st_uid=0))
    monkeypatch.setattr(Path, "exists", lambda *_: True)
    monkeypatch.delenv("SUDO_UID", raising=False)
    assert consent.belongs_to_another(file)
    monkeypatch.setenv("SUDO_UID", str(owner.st_uid))
    assert not consent.belongs_to_another(file)
