"""Fixtures of tests of recordings."""

import pytest

from tests.experiments.recordings import whole_run, write


@pytest.fixture
def path(tmp_path):
    return tmp_path / "run.mcap"


@pytest.fixture(scope="module")
def recorded(tmp_path_factory):
    """The bytes of a finished recording."""
    target = tmp_path_factory.mktemp("recorded") / "run.mcap"
    write(target, *whole_run())
    return target.read_bytes()
