"""A lab in use: one command runs an experiment, certificates are revoked and renewed while routers run."""

import threading
from contextlib import ExitStack, suppress
from pathlib import Path
from shutil import copytree

import pytest
import zenoh

from agents.network import messages, pubsub
from agents.network import session as network
from agents.network.keys import Keys
from experiments.real_time.hosts import authority
from tests.commands import zenpark
from tests.system.lab import TRIANGLE, Flight, in_lab, until
from tests.system.secured import Laboratory, refused

pytestmark = pytest.mark.system


def test_one_command_runs_while_others_watch_and_stop(tmp_path):
    flight = Flight(tmp_path / "run", in_lab(tmp_path), "--case", "event", "duration_s=90")
    flight.until_flown()
    endpoint, _, lab = flight.endpoint().partition("#lab=")
    assert endpoint.startswith("tls/127.0.0.1:")
    assert Path(lab) == tmp_path / "lab"
    reach = ("--connect", endpoint, "--lab", lab)
    shown = zenpark("keys", *reach)
    for name in TRIANGLE:
        assert f"\n{name}  running  " in f"\n{shown.stdout}"
    for token in ("park/run/conductor", "park/run/recorder"):
        assert f"  {token}\n" in shown.stdout
    assert "park/CF01/state" in shown.stdout
    assert zenpark("echo", "park/*/pose", "-n", "3", *reach).stdout.count('"robot":') == 3
    assert "park/CF01/state" in zenpark("echo", "park/*/state", "--rates", "--seconds", "1", *reach).stdout
    assert zenpark("echo", "park/run/scene", "-n", "1", *reach).stdout.endswith(" bytes, application/cdr>\n")
    zenpark("echo", "park/*/pose", "--seconds", "0.3", "--connect", endpoint, code=2)
    refused = zenpark("robot", "land", *reach, "--as", "observer", code=None)
    assert refused.stderr.count("no: no answer") == 3
    denied = zenpark("estop", *reach, "--as", "observer", code=1)
    assert "NOT known to have stopped: CF01, KH01, KH02" in denied.stderr
    assert zenpark("estop", *reach).stdout == f"stopped: CF01, KH01, KH02 (at {endpoint})\n"
    assert flight.finish()[0] == 1
    assert flight.logs().count("done (emergency stop by operator: zenpark estop)") == 3


@pytest.fixture(params=["tls", "quic"])
def laboratory(tmp_path, request):
    with Laboratory(tmp_path, request.param) as made:
        yield made


@pytest.mark.parametrize(
    "laboratory", [pytest.param("tls", marks=pytest.mark.mechanism("revocation")), "quic"], indirect=True
)
def test_revoked_key_is_refused_by_a_running_router(laboratory, tmp_path):
    stolen = copytree(laboratory.folder, tmp_path / "stolen")
    key, seen = Keys().pose("KH01"), set()
    with laboratory.session("operator") as operator, laboratory.session("KH01", stolen) as thief:
        samples = pubsub.subscriber(operator, key)

        def heard(speaker, word):
            """Whether the operator receives a word that is said now."""
            speaker.put(key, word)
            seen.update(sample.payload.to_string() for sample in network.received(samples.handler))
            return word in seen

        until(lambda: heard(thief, "before"), "the key is good")
        authority.revoke(laboratory.folder, ["KH01"])
        with ExitStack() as stack:

            def enter(folder):
                with suppress(zenoh.ZError):  # the router looks at its files now and then, or refuses at once
                    return [stack.enter_context(laboratory.session("KH01", folder))]
                return []

            # the operator's certificate is the same as ever: it is connected again by itself
            honest: list[zenoh.Session] = []
            until(lambda: honest or honest.extend(enter(laboratory.folder)), "the new key is let in")
            until(lambda: heard(honest[0], "after"), "the new key is good")
            threading.Event().wait(0.3)
            speakers = [thief, *enter(stolen)]
            for _ in range(20):
                assert not any(heard(each, "stolen") for each in speakers)
                threading.Event().wait(0.02)


def test_a_new_authority_refuses_every_earlier_file(laboratory, tmp_path):
    stolen = copytree(laboratory.folder, tmp_path / "stolen")
    with laboratory.session("operator", stolen) as before:
        assert network.connected(before)
        authority.renew(laboratory.folder, authority=True)

        def lets_in():
            with suppress(zenoh.ZError), laboratory.session("operator"):
                return True
            return False

        until(lets_in, "the router has taken the new authority up")
        for identity in ("operator", "KH01"):
            with refused():
                laboratory.session(identity, stolen)
        until(lambda: not network.connected(before), "who was connected is out")


def test_robots_continue_with_new_files_where_installed(laboratory):
    """A revocation costs a moment of the network; whoever finds new files in its folder is back by itself."""
    laboratory.fly()
    authority.revoke(laboratory.folder, ["KH01", "KH03"])
    watcher = laboratory.watcher
    before = {name: status.received for name, status in laboratory.statuses().items()}
    watcher.until(lambda: all(watcher.status[name].received > before[name] + 100 for name in before), "all hear again")
    for name, status in laboratory.statuses().items():
        assert status.phase == "running", (name, status.reason)
    assert watcher.order("CF01", messages.Order("land")).ok
