"""Certificates on their way to a host, by an `ssh` that runs everything on this machine."""

import os
import stat
import sys

import pytest

from experiments.definition.experiment import Host
from experiments.real_time.hosts import authority
from experiments.real_time.hosts.hosts import HostError
from experiments.real_time.hosts.installation import send
from tests.tools.commands.test_hosts import FAKE


@pytest.fixture
def home(tmp_path, monkeypatch):
    folder = tmp_path / "home"
    folder.mkdir()
    (tmp_path / "bin").mkdir()
    fake = tmp_path / "bin" / "ssh"
    fake.write_text(FAKE.format(python=sys.executable, home=str(folder)))
    fake.chmod(0o755)
    monkeypatch.setenv("PATH", f"{tmp_path / 'bin'}:{os.environ['PATH']}")
    return folder


@pytest.fixture
def lab(tmp_path):
    folder = tmp_path / "lab"
    authority.create(folder, {"router": "router", "KH01": "robot", "CF01": "robot"})
    return folder


def test_folder_holds_only_what_it_was_sent(home, lab):
    host, there = Host(address="lab1", lab="~/keys of mine"), home / "keys of mine"
    assert send("lab1", host, lab, ["KH01", "CF01"]) == "certificates of KH01, CF01 put into keys of mine"
    before = (there / "KH01.key").read_bytes()
    authority.renew(lab, ["KH01"])
    assert send("lab1", host, lab, ["KH01"]).endswith("; removed CF01.pem, CF01.key")
    assert sorted(file.name for file in there.iterdir()) == ["KH01.key", "KH01.pem", "ca.pem"]
    assert before != (there / "KH01.key").read_bytes() == (lab / "KH01.key").read_bytes()
    assert stat.S_IMODE(there.stat().st_mode) == 0o700
    assert {stat.S_IMODE(file.stat().st_mode) for file in there.iterdir()} == {0o600}


def test_what_is_not_its_own_is_left_alone(home, lab):
    there = home / "zenpark-lab"
    for strange, said in (("ca.key", "is the lab's own folder"), ("thesis.tex", "holds something else (thesis.tex)")):
        there.mkdir()
        (there / strange).touch()
        (there / "CF01.key").touch()
        with pytest.raises(HostError, match="certificates not put there") as caught:
            send("lab1", Host(address="lab1"), lab, ["KH01"])
        assert said in str(caught.value)
        assert 'lab = "zenpark-lab"' in str(caught.value)
        assert sorted(file.name for file in there.iterdir()) == sorted([strange, "CF01.key"])
        for file in there.iterdir():
            file.unlink()
        there.rmdir()


@pytest.mark.parametrize("place", ["", "~/", "/", ".", "../keys"])
def test_keys_need_a_folder_of_their_own(lab, place):
    with pytest.raises(HostError, match="names no folder of its own"):
        send("lab1", Host(address="lab1", lab=place), lab, ["KH01"])


def test_what_cannot_be_sent_is_said_before(home, lab):
    authority.renew(lab, ["CF01"], days=-0.01)
    with pytest.raises(HostError) as caught:
        send("lab1", Host(address="lab1"), lab, ["KH01", "CF01", "TB01"])
    assert "lab1: the certificate of CF01 ended at" in str(caught.value)
    assert "lab1: TB01 is not in the lab" in str(caught.value)
    assert not list(home.iterdir())


def test_a_host_that_is_not_there(home, lab):
    with pytest.raises(HostError, match="lab1: it cannot be reached"):
        send("lab1", Host(address="nobody"), lab, ["KH01"])
