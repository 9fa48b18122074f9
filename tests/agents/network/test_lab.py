"""Endpoints, which a session uses and which are refused; and labs: certificates on both ends, and their abuse."""

import json
import socket
import threading
from contextlib import ExitStack, contextmanager, suppress
from types import SimpleNamespace
from typing import NamedTuple

import pytest
import zenoh
from zenoh.handlers import FifoChannel

from agents.network import endpoints, lab, messages
from agents.network.access_control import Grant, Rights
from agents.network.endpoints import Endpoint, EndpointError, free_endpoint, free_endpoints
from agents.network.keys import Keys
from agents.network.lab import LabError, bare, files, lab_of, options, register, require, secured
from agents.network.session import Unreachable, connected, open_session, tokens_present
from agents.network.shutdown import leave
from agents.network.zenoh_config import config, settings
from agents.runtime import router as routing_process
from agents.runtime.router import MOST_SESSIONS, MOST_TOKENS, Guard, StuckCheck, serve_router
from experiments.real_time.hosts import authority
from tests.cases import for_each

MESH = ["tcp/127.0.0.1:1#of=A", "tcp/127.0.0.1:2#of=B+C", "tcp/127.0.0.1:3#of=D", "tcp/127.0.0.1:4#of=recorder"]


def test_parts_are_read_and_written():
    parts = {
        "tls/[::1]:7447#x=1": Endpoint("tls", "::1", 7447, "#x=1"),
        "quic/lab-1.example.org:65535?a=1": Endpoint("quic", "lab-1.example.org", 65535, "?a=1"),
        "unixsock-stream//tmp/x.sock": Endpoint("unixsock-stream", "/tmp/x.sock", 0),
    }
    assert {text: Endpoint.parse(text) for text in parts} == parts
    assert [str(endpoint) for endpoint in parts.values()] == list(parts)


@for_each(
    "text", ["", "tcp", "tcp/", "tcp/host", "tcp/host:", "tcp/:1", "tcp/host:0", "tcp/h:99999", "tcp/h:x", "udp/h:1"]
)
def test_what_is_no_endpoint_is_refused(text):
    with pytest.raises(ValueError, match="write it like tcp/127"):
        Endpoint.parse(text)


def test_who_reaches_it():
    here = ["tcp/127.0.0.1:1", "tcp/localhost:1", "tcp/[::1]:1", "unixsock-stream//x"]
    everywhere, elsewhere = ["tcp/0.0.0.0:1", "tcp/[::]:1"], ["tls/192.0.2.7:1", "tls/lab:1"]
    made = [Endpoint.parse(text) for text in here + everywhere + elsewhere]
    assert [str(endpoint) for endpoint in made if endpoint.is_loopback] == here
    assert [str(endpoint) for endpoint in made if endpoint.is_wildcard] == everywhere


@for_each(
    "use, endpoint, why",
    [
        ("listen", "tcp/host.example:7447", "SSH tunnel"),
        ("connect", "127.0.0.1:7447", "not an endpoint"),
        ("connect", "tcp/127.0.0.1:7447\n", "not an endpoint"),
        ("connect", "http/127.0.0.1:1", "no such protocol"),
        ("connect", "udp/127.0.0.1:1", "lost messages"),
        ("connect", "wss/127.0.0.1:1", "certificates"),
        ("connect", "serial//dev/ttyUSB0", "no network"),
    ],
)
def test_unusable_endpoints_are_refused_with_an_example(use, endpoint, why):
    with pytest.raises(EndpointError, match=why) as refusal:
        config(settings("router", **{use: [endpoint]}))
    assert endpoints.DEFAULT_ENDPOINT in str(refusal.value)


@for_each("endpoint", ["tcp/127.0.0.1:0", "tcp/127.3.2.1:7447", "tcp/[::1]:7447", "tcp/localhost:7447"])
def test_listens_on_loopback(endpoint):
    made = config(settings("router", listen=[endpoint], name="router", lease_s=1.5))
    assert made.get_json("listen/endpoints") == f'["{endpoint}"]'
    assert made.get_json("transport/link/tx/lease") == "1500"
    for off in ("scouting/multicast", "scouting/gossip", "transport/shared_memory"):
        assert made.get_json(f"{off}/enabled") == "false"


def test_free_endpoints_avoid_taken_ports():
    with socket.create_server(("127.0.0.1", 0)) as taken:
        port = taken.getsockname()[1]
        assert free_endpoint(port) != f"tcp/127.0.0.1:{port}"
    assert free_endpoint(port) == f"tcp/127.0.0.1:{port}"
    assert len(set(free_endpoints(3))) == 3


def test_the_later_of_two_members_connects():
    members = {"A": ([1], []), "B+C": ([2], [1]), "B": ([2], [1]), "recorder": ([4], [1, 2, 3])}
    visitors = {"zenpark echo": ([], [1, 2, 3, 4])}
    for name, (listens, connects) in (members | visitors).items():
        expected = ([f"tcp/127.0.0.1:{port}" for port in ports] for ports in (listens, connects))
        ends = endpoints.ends(MESH, name)
        assert (name, ends.mode, ends.visits, ends.listen, ends.connect) == (name, "peer", not listens, *expected)


def test_marks_stand_in_either_order_of_making():
    endpoint = endpoints.owned("tls/127.0.0.1:1#lab=/l", "A")
    assert endpoint == "tls/127.0.0.1:1#of=A#lab=/l"
    assert endpoints.owner(endpoint) == "A"
    assert endpoints.unowned(endpoint) == "tls/127.0.0.1:1#lab=/l"
    assert endpoints.bare([endpoint]) == ["tls/127.0.0.1:1"]
    assert endpoints.from_here("tls/0.0.0.0:7#lab=/l") == "tls/127.0.0.1:7#lab=/l"


def test_robot_knows_its_neighbours_and_services():
    senders = {"A": {"B"}, "B": set(), "C": set(), "D": {"A"}}
    assert endpoints.near(MESH, senders, ["A"]) == MESH  # it receives B, D receives it
    assert endpoints.near(MESH, senders, ["B", "C"]) == [MESH[0], MESH[1], MESH[3]]
    assert endpoints.near(MESH, senders, ["D"]) == [MESH[0], MESH[2], MESH[3]]
    routers = ["tcp/127.0.0.1:1", "tls/lab:2#lab=/x"]
    assert endpoints.near(routers, senders, ["D"]) == routers
    ends = endpoints.ends(routers, "A")
    assert (ends.mode, ends.connect, ends.listen, ends.visits) == ("client", routers, [], False)


def test_unreachable_names_endpoints_and_remedy():
    endpoint, stop = free_endpoint(preferred_port=0), threading.Event()
    with pytest.raises(Unreachable, match=rf"{endpoint}.*`./zenpark router`"):
        open_session([endpoint], name="test", wait_s=0.0)
    with pytest.raises(Unreachable, match="no member answers at"):
        open_session([endpoints.owned(endpoint, "A")], name="visitor", wait_s=0.05)
    stop.set()
    with pytest.raises(Unreachable):
        open_session([endpoint], name="test", wait_s=1e6, stop=stop)


def test_robots_and_sessions_own_keys():
    keys = Keys("park")
    alive = keys.alive("KH01")
    assert keys.robot_of(keys.pose("KH01")) == keys.robot_of(alive) == "KH01"
    for key in ("**", "park/**", "lab/KH01/pose", "park", "park/", "park//pose", ""):
        assert keys.robot_of(key) is None
    assert Keys.session_of(Keys.life(alive, "f00d")) == "f00d"
    assert Keys.session_of(Keys.claim(alive, Keys.rank(1e9, "f00d"))) == "f00d"
    assert Keys.session_of(alive) is None
    assert Keys.session_of("park/run/conductor") is None


KEYS = Keys()


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    made = tmp_path_factory.mktemp("labs") / "our lab #1, a=b"  # nothing in it may mean anything to Zenoh
    authority.create(made, {"router": "router", "operator": "operator", "CF01": "robot"})
    return made


def test_endpoints_carry_their_lab(folder):
    made = secured(["tls/127.0.0.1:7447", "quic/lab.example.org:7448"], folder)
    assert made == [f"tls/127.0.0.1:7447#lab={folder}", f"quic/lab.example.org:7448#lab={folder}"]
    assert secured(made, folder) == made
    assert bare(made) == ["tls/127.0.0.1:7447", "quic/lab.example.org:7448"]
    assert lab_of(made) == folder
    assert options(made[0]) == f"--connect tls/127.0.0.1:7447 --lab {folder}"
    assert options("tcp/127.0.0.1:7447") == "--connect tcp/127.0.0.1:7447"
    assert secured([], folder) == [f"tls/127.0.0.1:7447#lab={folder}"]  # on this machine
    assert secured([], None) == []
    assert lab_of(["tcp/127.0.0.1:7447"]) is None
    assert lab_of([]) is None


@for_each("character", [";", "?", "\n"])
def test_lab_path_with_reserved_character_is_refused(tmp_path, character):
    unusable = tmp_path / f"our{character}lab"
    for use in (lambda: secured([], unusable), lambda: authority.create(unusable, {"router": "router"})):
        with pytest.raises(LabError, match=r"rename or move the folder"):
            use()
    assert not unusable.exists()


@for_each("endpoint", ["tcp/127.0.0.1:7447", "unixsock-stream/tmp/x"])
def test_a_lab_needs_endpoints_that_ask_for_certificates(folder, endpoint):
    with pytest.raises(LabError, match=rf"{endpoint} asks for no certificate.*write tls/"):
        secured([endpoint], folder)
    with pytest.raises((EndpointError, LabError), match=r"asks for no certificate|cannot be used"):
        config(settings("client", connect=[f"{endpoint}#lab={folder}"], name="CF01"))
    with pytest.raises(LabError, match="one lab or to none"):
        lab_of([f"tls/127.0.0.1:1#lab={folder}", endpoint])


def test_lab_sessions_show_certificates_and_demand_them(folder):
    made = config(settings("client", connect=[f"tls/127.0.0.1:7447#lab={folder}"], name="CF01+CF02", identity="CF01"))
    assert made.get_json("connect/endpoints") == '["tls/127.0.0.1:7447"]'
    tls = json.loads(made.get_json("transport/link/tls"))
    assert tls["enable_mtls"] is tls["verify_name_on_connect"] is tls["close_link_on_expiration"] is True
    assert (tls["connect_certificate"], tls["listen_certificate"]) == (f"{folder}/CF01.pem", None)


@for_each("endpoint", ["tls/0.0.0.0:7447", "quic/[::]:7447", "tls/lab.example.org:7447"])
def test_router_listens_anywhere_only_with_a_lab(folder, endpoint):
    rights = Rights("park", {"CF01": Grant(publish=["park/CF01/**"])}, {})
    made = config(settings("router", listen=[f"{endpoint}#lab={folder}"], name="router", rights=rights))
    assert made.get_json("listen/endpoints") == f'["{endpoint}"]'
    assert '"default_permission":"deny"' in made.get_json("access_control")
    with pytest.raises(EndpointError, match=r"zenpark lab init LAB FILE.*--lab LAB"):
        config(settings("router", listen=[endpoint], name="router"))
    with pytest.raises(EndpointError, match="name the experiment"):
        config(settings("router", listen=[f"{endpoint}#lab={folder}"], name="router"))


def test_unusable_lab_is_named_with_its_remedy(folder, tmp_path):
    with pytest.raises(LabError, match=r"CF09\.pem is missing: .*`./zenpark lab issue .* CF09`"):
        files(folder, "CF09")
    with pytest.raises(LabError, match=r"no certificates of CF08, CF09: `./zenpark lab issue .* CF08 CF09`"):
        require(folder, ["CF01", "CF08", "CF09"])
    with pytest.raises(LabError, match=r"is no lab, lab\.json is missing: `./zenpark lab init"):
        register(tmp_path)
    (tmp_path / lab.REGISTER).write_text("{")
    with pytest.raises(LabError, match="put it back"):
        register(tmp_path)
    authority.create(tmp_path / "lab", {"CF01": "robot"})
    (tmp_path / "lab" / "CF01.key").chmod(0o640)
    with pytest.raises(LabError, match="chmod 600"):
        files(tmp_path / "lab", "CF01")


def test_an_id_belongs_to_one_certificate():
    certificates = {"CF01": "CF01.2", "KH01": "KH01", "observer": "observer"}
    known = lab.Register({name: lab.Identity("robot", common, "1", "2100") for name, common in certificates.items()})
    zid = lab.session_id("CF01")
    assert (len(zid), zid[0] != "0", zid != lab.session_id("CF01")) == (32, True, True)
    for session, common, robbed in (
        (zid, "CF01.2", None),
        (zid, "CF01", "CF01"),  # it was revoked
        (zid, "KH01", "CF01"),
        (zid, None, "CF01"),
        ("f00d", "observer", None),  # a foreign program chooses its own
    ):
        assert lab.robbed(known, session, common) == robbed


@pytest.mark.mechanism("stolen Zenoh id")
@pytest.mark.system
def test_a_thief_of_an_id_keeps_nobody_out(tmp_path, eventually):
    """The thief comes first, as at a restart of the router, and again and again."""
    with routing(tmp_path / "lab") as endpoint, ExitStack() as stack:
        zid = lab.session_id("CF01")
        thief, owner = (client(endpoint, name, id=zid) for name in ("operator", "CF01"))
        opened = {}

        def let_in(name, chosen):
            with suppress(zenoh.ZError):  # the thief may be disconnected before it is in
                opened[name] = zenoh.open(chosen)
                stack.callback(leave, opened[name])
            return name in opened

        let_in("thief", thief)
        eventually(lambda: let_in("owner", owner))
        eventually(lambda: connected(opened["owner"]) and not ("thief" in opened and connected(opened["thief"])))


@contextmanager
def routing(folder):
    """The endpoint of the router of a new lab with the robots CF01 and KH01."""
    authority.create(folder, {"router": "router", "operator": "operator", "CF01": "robot", "KH01": "robot"})
    (endpoint,) = secured([free_endpoint(preferred_port=0, protocol="tls")], folder)
    own = {name: Grant([f"park/{name}/**"], tokens=KEYS.owner_tokens(KEYS.alive(name))) for name in ("CF01", "KH01")}
    rights = Rights("park", own, {"operator": Grant(subscribe=["park/**"], watch=["park/**"])})
    stop, ready = threading.Event(), threading.Event()
    given = {"rights": rights, "ready": lambda _: ready.set()}
    router = threading.Thread(target=serve_router, args=([endpoint], stop), kwargs=given)
    router.start()
    try:
        assert ready.wait(100.0)
        yield endpoint
    finally:
        stop.set()
        router.join()


def client(endpoint, name, **more):
    return config({**settings("client", connect=[endpoint], name=name, identity=name), **more})


@pytest.mark.mechanism("too many liveliness tokens")
@pytest.mark.system
def test_router_disconnects_holder_of_too_many_tokens(tmp_path, eventually):
    with routing(tmp_path / "lab") as endpoint, ExitStack() as stack:
        holder, honest, operator = (zenoh.open(client(endpoint, name)) for name in ("CF01", "KH01", "operator"))
        for session in (holder, honest, operator):
            stack.callback(leave, session)
        hazards = operator.declare_subscriber(KEYS.event, FifoChannel(16))
        alive = KEYS.alive("CF01")
        kept = [honest.liveliness().declare_token(key) for key in honest_tokens("KH01", honest)]
        kept += [honest.liveliness().declare_token(key) for key in (alive, KEYS.life(alive, "f00d"))]  # both are denied
        kept += [
            holder.liveliness().declare_token(KEYS.claim(alive, KEYS.rank(n, str(holder.zid()))))
            for n in range(MOST_TOKENS + 1)
        ]
        eventually(lambda: not connected(holder))
        told = messages.decode(hazards.recv().payload.to_bytes(), messages.JSON, messages.Event)
        assert (told.kind, told.source) == ("hazard", "router")
        assert "certificate of CF01 may hold some of more than 1000 liveliness tokens" in told.text
        assert {*honest_tokens("KH01", honest)} <= tokens_present(operator, "park/KH01/**")
        assert connected(honest)


class Link(NamedTuple):
    """Link of a router as Zenoh describes it."""

    zid: str
    auth_identifier: str
    dst: str = "tls/127.0.0.1:1"


class Events:
    """Session of a router that only reports what happens; whoever asks it anything fails."""

    def __init__(self):
        self.info = self

    def liveliness(self):
        return self

    def declare_link_events_listener(self, callback, *, history):
        self.link = lambda link, kind=zenoh.SampleKind.PUT: callback.callback(SimpleNamespace(link=link, kind=kind))

    def declare_subscriber(self, key, callback, *, history):
        self.token = lambda key, kind=zenoh.SampleKind.PUT: callback.callback(SimpleNamespace(key_expr=key, kind=kind))


@pytest.fixture
def guarded(monkeypatch):
    """Guard of a lab's router, without a network, and the links that it has hung up on."""
    roles = {"router": "router", "ana": "operator", "observer": "observer", "CF01": "robot", "KH01": "robot"}
    identities = {name: lab.Identity(role, name, "1", "2100") for name, role in roles.items()}
    own = {name: Grant(tokens=KEYS.owner_tokens(KEYS.alive(name))) for name in ("CF01", "KH01")}
    events, hung_up = Events(), []
    monkeypatch.setattr(routing_process, "hang_up_on", lambda link: hung_up.append(link) or True)
    guard = Guard(events, lambda: lab.Register(dict(identities)), Rights("park", own, {}))
    return SimpleNamespace(guard=guard, link=events.link, token=events.token, hung_up=hung_up, identities=identities)


def test_a_new_certificate_may_come_before_its_rules(guarded):
    """A robot that was disconnected whenever it came, 200 times a second, was not connected again afterwards."""
    zid = lab.session_id("CF01")
    guarded.link(Link(zid, "CF01.2"))
    assert [link.auth_identifier for link in guarded.hung_up] == ["CF01.2"]
    guarded.hung_up.clear()
    guarded.identities["CF01"] = lab.Identity("robot", "CF01.2", "1", "2100")
    guarded.link(Link(zid, "CF01.2"))
    assert not guarded.hung_up
    guarded.link(Link(zid, "KH01"))
    assert [link.auth_identifier for link in guarded.hung_up] == ["KH01"]


def test_certificate_has_a_few_sessions(guarded):
    observers = [Link(str(number), "observer") for number in range(MOST_SESSIONS + 1)]
    trusted = [Link(f"{name}{number}", name) for number in range(MOST_SESSIONS + 1) for name in ("router", "ana")]
    for link in (*observers[:-1], *trusted):
        guarded.link(link)
    assert not guarded.hung_up
    guarded.link(observers[-1])
    assert guarded.hung_up == observers[-1:]
    for link in observers[:2]:
        guarded.link(link, zenoh.SampleKind.DELETE)
    guarded.link(Link("later", "observer"))
    assert guarded.hung_up == observers[-1:]


def test_tokens_beyond_the_limit_cost_the_link(guarded):
    for name in ("CF01", "KH01"):
        guarded.link(Link(name, name))
    for number in range(MOST_TOKENS):
        guarded.token(KEYS.life(KEYS.alive("CF01"), str(number)))
    guarded.token(KEYS.life(KEYS.alive("CF01"), "0"), zenoh.SampleKind.DELETE)
    guarded.token(KEYS.life(KEYS.alive("CF01"), "1000"))
    assert not guarded.hung_up
    for number in (1001, 1002):
        guarded.token(KEYS.life(KEYS.alive("CF01"), str(number)))
    assert guarded.hung_up == [Link("CF01", "CF01")]


def test_nobody_may_ask_for_a_labs_tables(folder):
    listen = f"tls/127.0.0.1:7447#lab={folder}"
    secure = settings("router", listen=[listen], name="router", rights=Rights("park", {}, {}))
    assert secure["adminspace/enabled"] is False
    assert config(secure).get_json("adminspace/enabled") == "false"


@pytest.mark.parametrize("mode", ["client", "peer", "router"])
def test_members_that_do_not_read_delay_shortly(mode):
    queue = json.loads(config(settings(mode)).get_json("transport/link/tx/queue/congestion_control"))
    assert queue["block"]["wait_before_close"] == queue["drop"]["max_wait_before_drop_fragments"] == 20_000  # [µs]
    assert queue["drop"]["wait_before_drop"] == 1_000


def test_router_without_an_answer_ends_its_process(eventually):
    late, before = threading.Event(), threading.active_count()
    for answer in (lambda: False, late.wait):
        codes = []
        check = StuckCheck(answer, codes.append)
        check.start()
        eventually(lambda: codes == [1])  # noqa: B023 - called in this turn
        check.end()
    late.set()
    eventually(lambda: threading.active_count() <= before)


def honest_tokens(name, session):
    alive, zid = KEYS.alive(name), str(session.zid())
    return [alive, KEYS.life(alive, zid), KEYS.claim(alive, KEYS.rank(1e9, zid))]
