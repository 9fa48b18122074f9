"""One process for each device: the second is refused by name, and a lock ends with its process."""

import pytest

from agents.body.device_locks import Claims, numeric
from agents.body.interface import BodyError
from agents.protocols.crazyflie import device_of
from tests.commands import started

pytestmark = pytest.mark.usefixtures("runtime_folder")

HOLDER = """
from agents.body.device_locks import Claims
Claims(["CF07"], ["radio 80"]).take()
print("has it", flush=True)
input()
"""


def test_device_has_one_holder_until_released(runtime_folder):
    first, second = Claims(["A", "B"], ["one", "two"]), Claims(["C", "D"], ["three", "two"])
    first.take()
    with pytest.raises(BodyError, match=r"^D: two is in use: this process drives it for B; end that first$"):
        second.take()
    second.release()  # refused: what the first has is left alone
    assert len(list(runtime_folder.iterdir())) == 2
    Claims(["C"], ["three"]).take()  # which the second has let go of
    first.release()
    second.release()
    first.release()
    third = Claims(["D"], ["two"])
    third.take()
    third.release()


def test_holder_is_named_and_its_death_frees_device(runtime_folder):
    mine = Claims(["CF01"], ["radio 80"])
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
        Claims(["CF01"], ["radio 80"]).take()


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
    devices = [{device_of(address) for address in addresses} for addresses in spellings]
    assert [len(each) for each in devices] == [1] * len(spellings)
    assert len(set.union(*devices)) == len(spellings)


def test_unresolvable_host_keeps_its_name():
    assert numeric("No.Such.invalid") == "no.such.invalid"
    assert numeric("127.1") == "127.0.0.1"
