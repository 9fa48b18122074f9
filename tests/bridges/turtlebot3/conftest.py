import pytest

from tests.conftest import RouterProcess


@pytest.fixture(scope="module")
def hub():
    """One router for all tests that leave it alone."""
    made = RouterProcess()
    yield made
    made.stop()
