"""Stops are heard from before the first case: a router of the run's own may take its time to start."""

import threading

import pytest

from agents.network.endpoints import free_endpoint
from agents.network.keys import Keys
from agents.network.session import Unreachable
from agents.runtime.router import serve_router
from experiments.real_time.conductor.emergency import STARTING_S, Emergency

KEYS = Keys("park")


@pytest.fixture
def endpoint():
    return free_endpoint(preferred_port=0)


def test_router_that_just_started_is_waited_for(endpoint):
    over = threading.Event()
    late = threading.Timer(0.6, serve_router, ([endpoint], over))
    late.start()
    try:
        with Emergency().throughout([endpoint], KEYS, "operator", STARTING_S):
            pass
    finally:
        over.set()
        late.join()


def test_one_of_somebody_else_is_not(endpoint):
    with pytest.raises(Unreachable), Emergency().throughout([endpoint], KEYS, "operator", 0.2):
        pass
