"""Files that are written again stay as they were where there is no room."""

import resource
import signal

import pytest

from agents.errors import replacing
from experiments.recording.run_folder import RunOrigin, keep_origin
from experiments.report import metrics_files, page
from experiments.sweep import table

WRITERS = {
    "metrics.json": lambda file: metrics_files.write_json(file, []),
    "metrics.csv": lambda file: metrics_files.write_csv(file, []),
    "errors.csv": lambda file: metrics_files.write_bands(file, {}),
    "sweep.json": lambda file: table.write_json(file, {"cells": []}),
    "sweep.csv": lambda file: table.write_csv(file, [], {}),
    "run.json": lambda file: keep_origin(file.parent, RunOrigin()),
    "report.html": lambda file: page.render(file, title="", source="", facts=[], verdict=[], sections=[]),
}


@pytest.fixture
def no_room():
    """A disk that takes a byte of a file: Python ignores the signal, and the write fails."""
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    handler = signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
    resource.setrlimit(resource.RLIMIT_FSIZE, (1, before[1]))
    yield
    resource.setrlimit(resource.RLIMIT_FSIZE, before)
    signal.signal(signal.SIGXFSZ, handler)


@pytest.mark.parametrize("name", WRITERS)
def test_former_file_stays_without_room(name, tmp_path, request):
    file = tmp_path / name
    file.write_text("former")
    request.getfixturevalue("no_room")
    with pytest.raises(OSError, match="too large"):
        WRITERS[name](file)
    assert file.read_text() == "former"
    assert list(tmp_path.iterdir()) == [file]


@pytest.mark.parametrize("name", WRITERS)
def test_file_takes_the_place_of_the_former(name, tmp_path):
    file = tmp_path / name
    file.write_text("former")
    WRITERS[name](file)
    assert file.read_text() != "former"
    assert list(tmp_path.iterdir()) == [file]


def test_link_stays_one(tmp_path):
    (tmp_path / "lab.toml").write_text("former")
    link = tmp_path / "link.toml"
    link.symlink_to("lab.toml")
    with replacing(link) as fresh:
        fresh.write_text("new")
    assert link.is_symlink()
    assert (tmp_path / "lab.toml").read_text() == "new"
