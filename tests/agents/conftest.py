"""Fixtures that several tests of a robot's process share."""

import os

import pytest


@pytest.fixture
def pipe():
    ends = list(os.pipe())
    yield ends
    for end in ends:
        os.close(end)
