"""End of the clean process that flights are forked from."""

from collections.abc import Iterator

import pytest

from tests.simulated import laboratory


@pytest.fixture(scope="session", autouse=True)
def _laboratory() -> Iterator[None]:
    yield
    laboratory.close()
