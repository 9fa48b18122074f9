"""Locks of devices: a single driver for each, by all names of its host."""

import ipaddress
import socket
import threading
from contextlib import nullcontext

import pytest

from agents.body.device_address import DeviceAddress, plain_device, resolved
from agents.body.device_locks import Claims
from agents.body.interface import BodyError
from bridges.crazyflie.protocol.addresses import device_of
from tests.commands import started

HOLDER = """
from agents.body.device_address import DeviceAddress
from agents.body.device_locks import Claims
Claims([("CF07", DeviceAddress("radio 80", parts=("80",)))]).take()
print("has it", flush=True)
input()
"""


def claims(*rows):
    """Claims of robots and addresses."""
    return Claims([(name, DeviceAddress(address, parts=(address,))) for name, address in rows])


def test_device_has_one_holder_until_released(runtime_folder):
    first, second = claims(("A", "one"), ("B", "two")), claims(("C", "three"), ("D", "two"))
    first.take()
    with pytest.raises(BodyError, match=r"^D: two is in use: this process drives it for B; end that first$"):
        second.take()
    second.release()  # refused: what the first has is left alone
    assert len(list(runtime_folder.iterdir())) == 2
    claims(("C", "three")).take()  # the second process has let go of it
    first.release()
    second.release()
    first.release()
    third = claims(("D", "two"))
    third.take()
    third.release()


def test_holder_is_named_and_its_death_frees_device(runtime_folder):
    mine = Claims([("CF01", DeviceAddress("radio 80", parts=("80",)))])
    with started("-c", HOLDER) as other:
        assert other.stdout.readline() == "has it\n"
        with pytest.raises(BodyError, match=f"^CF01: radio 80 is in use: process {other.pid} drives it for CF07; end"):
            mine.take()
    assert len(list(runtime_folder.iterdir())) == 1  # the file is left, the lock is not
    mine.take()
    mine.release()
    assert list(runtime_folder.iterdir()) == []


def test_without_a_folder_nothing_is_driven(runtime_folder):
    runtime_folder.mkdir(0o755)
    runtime_folder.chmod(0o777)
    with pytest.raises(
        BodyError, match=r"no lock on radio 80, .* set ZENPARK_RUNTIME_DIR to a folder that is yours alone"
    ):
        claims(("CF01", "radio 80")).take()


def test_spellings_of_one_crazyflie_are_one_device():
    spellings = [
        ("radio://0/80/2M", "radio://1/80/2M/e7e7e7e7e7?rate_limit=100"),
        ("radio://0/80/2M/E7E7E7E701", "radio://0/80/2M/e7e7e7e701"),
        ("radio://0/80/2M/1", "radio://E7ABCD/80/2M/0000000001"),
        ("usb://0", "usb://00"),
        ("udp://localhost:19850", "udp://127.0.0.1:19850"),
        *(("radio://0/80/2M/E7E7E7E702",), ("radio://0/81/2M/E7E7E7E701",), ("radio://0/80/1M/E7E7E7E701",)),
        *(("usb://1",), ("udp://127.0.0.1:1",), ("udp://127.0.0.1:2",)),
    ]
    devices = [{frozenset(device_of(address).lock_keys()) for address in addresses} for addresses in spellings]
    assert [len(each) for each in devices] == [1] * len(spellings)
    assert len(set.union(*devices)) == len(spellings)


HOSTS = {
    "lab.example": ["192.0.2.7", "2001:db8::7"],
    "other.example": ["192.0.2.8"],
    "this-computer": ["127.0.1.1"],
    "localhost": ["::1", "127.0.0.1"],
}


@pytest.fixture
def names_of_hosts(monkeypatch):
    """A name server with a few names; `never` does not answer."""
    ended = threading.Event()

    def ask(host, *_, **__):
        host = host.lower().rstrip(".")
        if host == "never":
            ended.wait()
        try:
            addresses = HOSTS.get(host) or [str(ipaddress.ip_address(host))]
        except ValueError:
            raise socket.gaierror(socket.EAI_AGAIN, "no such name") from None
        return [(socket.AF_INET, socket.SOCK_STREAM, 0, "", (each, 0)) for each in addresses]

    monkeypatch.setattr(socket, "getaddrinfo", ask)
    yield
    ended.set()


@pytest.mark.usefixtures("runtime_folder", "names_of_hosts")
@pytest.mark.parametrize(
    ("first", "second", "same"),
    [
        ("rover://localhost:5005", "rover://127.0.0.1:5005", True),
        ("rover://localhost:5005", "rover://[::1]:5005", True),
        ("rover://127.0.0.1:5005", "rover://[::ffff:127.0.0.1]:5005", True),
        ("rover://127.1:5005", "rover://this-computer:5005", True),
        ("rover://127.0.0.2", "rover://127.0.0.1", False),  # simulated devices
        ("rover://lab.example:5005", "ROVER://192.0.2.7:5005/", True),
        ("rover://Lab.Example.:5005", "rover://[2001:db8:0::7]:5005?rate=5", True),
        ("rover://lab.example:5005", "rover://other.example:5005", False),
        ("rover://lab.example:5005", "rover://lab.example:5006", False),
        ("rover://lab.example:5005", "rover://192.0.2.7", True),  # a port that is left out may be this one
        ("rover://192.0.2.7/1", "rover://lab.example:5005/1", True),
        ("rover://192.0.2.7/1", "rover://lab.example/2", False),
        ("rover://192.0.2.7%wlan1", "rover://192.0.2.7%wlan2", False),
        ("rover://192.0.2.7%wlan1", "rover://192.0.2.7", True),
        ("rover://192.0.2.7:5005", "crawler://lab.example:5005", True),  # whatever word it has
        ("rover://channel7", "rover://channel7/", True),  # no name of a host
        ("rover://0/80", "rover://0/81", False),
        ("rover://%", "ROVER://%", True),  # neither a host nor anything else
        ("rover://%", "rover://", False),
        ("rover:///dev/stdin", "rover:///proc/self/fd/0", True),  # links to files
    ],
)
def test_one_device_has_one_driver_by_any_name(first, second, same):
    one, two = (Claims([(name, plain_device(address))]) for name, address in (("A", first), ("B", second)))
    for mine, other in ((one, two), (two, one)):
        mine.take()
        with pytest.raises(BodyError, match="is in use: this process drives it") if same else nullcontext():
            other.take()
        other.release()
        mine.release()


@pytest.mark.usefixtures("runtime_folder", "names_of_hosts")
def test_shared_part_of_an_address_stays_locked():
    ports = [Claims([(name, plain_device(f"rover://192.0.2.7:{name}"))]) for name in ("5005", "5006")]
    for each in ports:
        each.take()
    ports[0].release()
    with pytest.raises(BodyError, match="drives it for 5006; end that first"):
        Claims([("whole", plain_device("rover://192.0.2.7"))]).take()


@pytest.mark.usefixtures("names_of_hosts")
def test_silent_name_server_delays_no_robot_for_long():
    assert resolved(["never", "lab.example", "nobody"], 0.05) == {
        "never": set(),
        "lab.example": {"192.0.2.7", "2001:db8::7"},
        "nobody": set(),
    }
