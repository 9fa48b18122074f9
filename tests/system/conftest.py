"""Fixtures that several tests of real processes share."""

import pytest

from tests.system.lab import Watcher


@pytest.fixture
def watcher(router):
    with Watcher(router.endpoint) as made:
        yield made
