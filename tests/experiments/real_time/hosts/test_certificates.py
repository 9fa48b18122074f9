"""Certificates of a lab on a machine, and the findings about them."""

import shutil
import time

import pytest

from agents.network.lab import register
from experiments.definition.experiment import Host
from experiments.real_time.hosts import authority, certificates
from experiments.real_time.hosts.certificates import ended, faults, fingerprint, misplaced_keys, read_folder, unnamed

ROBOTS = ["KH01", "CF01"]


@pytest.fixture
def lab(tmp_path):
    folder = tmp_path / "lab"
    authority.create(folder, {"router": "router", **dict.fromkeys([*ROBOTS, "KH02"], "robot")})
    return folder


@pytest.fixture
def there(lab, tmp_path):
    """A machine's folder with what belongs there."""
    folder = tmp_path / "there"
    folder.mkdir(mode=0o700)
    for name in ("ca.pem", *(f"{robot}.{end}" for robot in ROBOTS for end in ("pem", "key"))):
        shutil.copy(lab / name, folder)
    return folder


def said(there, lab, clock=None):
    return list(faults(read_folder(there, ROBOTS), lab, time.time() if clock is None else clock))


def test_nothing_is_said_of_what_counts(lab, there):
    found = read_folder(there, ROBOTS)
    assert said(there, lab) == list(misplaced_keys(found, "lab1")) == list(ended(lab, ROBOTS)) == []
    assert certificates.days_left(lab, ROBOTS) == pytest.approx(90.0, abs=0.1)
    assert not any("PRIVATE" in text for text in (found.authority, *(each.certificate for each in found.identities)))


INSTALL = "; `./zenpark hosts install"


def test_each_fault_has_its_remedy(lab, there, tmp_path):
    assert said(tmp_path / "nowhere", lab)[0].startswith(f"has no certificates of KH01, CF01{INSTALL}")
    key = there / "KH01.key"
    for spoil, fault in (
        (lambda: key.chmod(0o644), f"others can read KH01.key; revoke it if they have read it{INSTALL}"),
        (key.unlink, f"KH01.key is missing{INSTALL}"),
        (lambda: shutil.copy(lab / "CF01.key", key), f"KH01.key is not the key of KH01.pem{INSTALL}"),
    ):
        spoil()
        assert said(there, lab)[0].startswith(fault)
    shutil.copy(lab / "KH01.key", there)
    (there / "CF01.pem").write_text("nonsense")
    assert said(there, lab)[0].startswith("CF01.key is not the key of CF01.pem")


def test_what_no_longer_counts_is_told_apart(lab, there, tmp_path):
    authority.renew(lab, ["KH01"])
    authority.revoke(lab, ["CF01"])
    for fault, (name, fate) in zip(said(there, lab), (("KH01", "renewed"), ("CF01", "revoked")), strict=True):
        assert fault.startswith(f"the certificate of {name} there has been {fate} since{INSTALL}")
    before = fingerprint((lab / "ca.pem").read_text())
    authority.renew(lab, authority=True)
    now = fingerprint((lab / "ca.pem").read_text())
    (only,) = said(there, lab)
    assert f"(ca.pem {before[:12]}, here {now[:12]})" in only
    other = tmp_path / "other"
    authority.create(other, {"router": "router"})
    shutil.copy(other / "ca.pem", there)
    assert "of another lab" in said(there, lab)[0]
    shutil.copy(lab / "ca.pem", there)
    shutil.copy(lab / "lab.json", other)
    assert said(there, other)[0].startswith("its certificates are of another lab")


def test_expired_certificates_and_clocks_outside_validity_are_reported(lab, there):
    def renew(**more):
        authority.renew(lab, ["KH01"], **more)
        for end in ("pem", "key"):
            shutil.copy(lab / f"KH01.{end}", there)

    renew(days=-0.01)
    (only,) = said(there, lab)
    assert only.startswith("the certificate of KH01 ended at ")
    assert f"`./zenpark lab renew {lab} KH01`, then `./zenpark hosts install FILE`" in only
    assert f"`./zenpark lab renew {lab} KH01`" in next(ended(lab, ROBOTS))
    renew()
    (first, second) = said(there, lab, 0.0)
    assert first.startswith("its clock says 1970-01-01 00:00 UTC, when KH01 has no valid certificate; set it (NTP)")
    assert "CF01" in second


def test_robot_outside_the_lab_cannot_be_sent(lab, there):
    found = certificates.FolderContent(read_folder(there, ROBOTS).authority, read_folder(there, ["TB01"]).identities)
    assert next(faults(found, lab, time.time())).startswith(f"TB01 is not in the lab {lab}; `./zenpark lab issue")
    assert next(ended(lab, ["TB01"])).startswith("TB01 is not in the lab")
    (lab / "CF01.key").unlink()
    assert "CF01.key is missing" in next(ended(lab, ["CF01"]))
    assert "TB01" not in register(lab).identities


def test_keys_of_others_do_not_belong_there(lab, there):
    for name in ("KH02.key", "ca.key"):
        shutil.copy(lab / name, there)
    (only,) = misplaced_keys(read_folder(there, ROBOTS), "lab1")
    assert only.startswith(
        "holds KH02.key, ca.key, which do not belong on lab1; `./zenpark hosts install FILE` removes"
    )


def test_router_is_trusted_under_its_certificates_names(lab):
    assert list(unnamed(["tls/127.0.0.1:7447", "quic/localhost:1"], lab)) == []
    (only,) = unnamed(["tls/192.0.2.7:7447", "quic/192.0.2.7:7448"], lab)
    assert f"`./zenpark lab renew {lab} router --host 192.0.2.7`" in only
    authority.renew(lab, ["router"], hosts=["192.0.2.7"])
    assert list(unnamed(["tls/192.0.2.7:7447"], lab)) == []


def test_two_hosts_that_are_one_folder_share_it():
    hosts = {
        "a": Host(address="pi@x", robots=["KH01"]),
        "b": Host(address="pi@x", robots=["CF01"]),
        "c": Host(address="pi@x", robots=["KH02"], lab="other"),
    }
    assert certificates.of_host("a", hosts) == certificates.of_host("b", hosts) == ["KH01", "CF01"]
    assert certificates.of_host("c", hosts) == ["KH02"]
