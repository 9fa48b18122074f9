"""Which run `./zenpark view` shows."""

import os
import threading

import pytest

from experiments.real_time.hosts import run_registry
from experiments.recording.run_folder import SOURCE
from tools.commands import view


@pytest.mark.parametrize("age_s", [0.0, 2.0 * view.START_S])
def test_view_waits_for_a_run_that_begins(age_s, tmp_path, monkeypatch):
    monkeypatch.setenv("ZENPARK_RUNTIME_DIR", str(tmp_path / "runtime"))
    begun, entry = threading.Event(), run_registry.own_entry("run", "a run", ["tcp/127.0.0.1:7447"], folder=tmp_path)
    (tmp_path / SOURCE).write_text("")
    at = (tmp_path / SOURCE).stat().st_mtime - age_s
    os.utime(tmp_path / SOURCE, (at, at))

    def register():
        with run_registry.registered(entry):
            begun.wait(60.0)

    starting = threading.Timer(0.3, register)
    starting.start()
    try:
        found = view._starting_run(tmp_path, threading.Event())
    finally:
        begun.set()
        starting.join()
    assert found == (None if age_s else entry)
