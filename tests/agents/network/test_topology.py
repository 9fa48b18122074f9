"""What a session does about the endpoints that it is given."""

import pytest

from agents.network import endpoints
from agents.network.endpoints import EndpointError, free_endpoint, free_endpoints
from agents.network.session import Unreachable, open_session
from agents.network.zenoh_config import config, settings

MESH = ["tcp/127.0.0.1:1#of=A", "tcp/127.0.0.1:2#of=B+C", "tcp/127.0.0.1:3#of=D", "tcp/127.0.0.1:4#of=recorder"]


def test_without_owners_endpoints_are_routers():
    ends = endpoints.ends(["tcp/127.0.0.1:1", "tls/lab:2#lab=/x"], "A")
    assert (ends.mode, ends.connect, ends.listen) == ("client", ["tcp/127.0.0.1:1", "tls/lab:2#lab=/x"], [])
    assert not ends.visits


@pytest.mark.parametrize(
    ("name", "listens", "connects"),
    [("A", 1, []), ("B+C", 2, [1]), ("B", 2, [1]), ("D", 3, [1, 2]), ("recorder", 4, [1, 2, 3])],
)
def test_the_later_of_two_members_connects(name, listens, connects):
    ends = endpoints.ends(MESH, name)
    assert ends.mode == "peer"
    assert ends.listen == [f"tcp/127.0.0.1:{listens}"]
    assert ends.connect == [f"tcp/127.0.0.1:{port}" for port in connects]
    assert not ends.visits


def test_a_visitor_connects_to_all_and_listens_nowhere():
    ends = endpoints.ends(MESH, "zenpark echo")
    assert ends.visits
    assert ends.connect == [f"tcp/127.0.0.1:{port}" for port in (1, 2, 3, 4)]


def test_marks_stand_in_either_order_of_making():
    endpoint = endpoints.owned("tls/127.0.0.1:1#lab=/l", "A")
    assert endpoint == "tls/127.0.0.1:1#of=A#lab=/l"
    assert endpoints.owner(endpoint) == "A"
    assert endpoints.unowned(endpoint) == "tls/127.0.0.1:1#lab=/l"
    assert endpoints.bare([endpoint]) == ["tls/127.0.0.1:1"]
    assert endpoints.from_here("tls/0.0.0.0:7#lab=/l") == "tls/127.0.0.1:7#lab=/l"


def test_robot_knows_its_neighbours_and_services():
    hears = {"A": {"B"}, "B": set(), "C": set(), "D": {"A"}}
    assert endpoints.near(MESH, hears, ["A"]) == MESH  # B is heard, D hears it
    assert endpoints.near(MESH, hears, ["B", "C"]) == [MESH[0], MESH[1], MESH[3]]
    assert endpoints.near(MESH, hears, ["D"]) == [MESH[0], MESH[2], MESH[3]]
    assert endpoints.near(["tcp/127.0.0.1:1"], hears, ["D"]) == ["tcp/127.0.0.1:1"]


def test_lab_listeners_must_know_the_rights(tmp_path):
    from experiments.real_time.hosts import authority  # noqa: PLC0415

    folder = tmp_path / "lab"
    authority.create(folder, {"A": "robot"}, hosts=["127.0.0.1"])
    with pytest.raises(EndpointError, match="needs its access rights"):
        config(settings("peer", listen=[f"tls/127.0.0.1:1#lab={folder}"], name="A"))


def test_nobody_in_a_mesh_is_said_so():
    endpoint = endpoints.owned(free_endpoint(0), "A")
    with pytest.raises(Unreachable, match="no member answers at"):
        open_session([endpoint], name="visitor", wait_s=0.05)


def test_free_endpoints_differ():
    made = free_endpoints(3)
    assert len(set(made)) == 3
