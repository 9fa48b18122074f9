"""Fixtures that several tests of real processes share."""

import pytest

from tests.system.lab import Watcher


@pytest.fixture
def watcher(router):
    made = Watcher(router.endpoint)
    yield made
    made.close()
