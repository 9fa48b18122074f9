"""Fixtures that several tests of real processes share."""

from __future__ import annotations

from collections.abc import Iterator

import pytest

from tests.conftest import RouterProcess
from tests.system.lab import Watcher


@pytest.fixture
def watcher(router: RouterProcess) -> Iterator[Watcher]:
    made = Watcher(router.endpoint)
    yield made
    made.close()
