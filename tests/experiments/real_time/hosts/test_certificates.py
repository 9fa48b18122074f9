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
def lab_folder(tmp_path):
    folder = tmp_path / "lab"
    authority.create(folder, {"router": "router", **dict.fromkeys([*ROBOTS, "KH02"], "robot")})
    return folder


@pytest.fixture
def there(lab_folder, tmp_path):
    """A machine's folder with what belongs there."""
    folder = tmp_path / "there"
    folder.mkdir(mode=0o700)
    for name in ("ca.pem", *(f"{robot}.{end}" for robot in ROBOTS for end in ("pem", "key"))):
        shutil.copy(lab_folder / name, folder)
    return folder


def faults_of(there, lab_folder, clock=None):
    return list(faults(read_folder(there, ROBOTS), lab_folder, time.time() if clock is None else clock))


def test_nothing_is_said_of_what_counts(lab_folder, there):
    found = read_folder(there, ROBOTS)
    assert faults_of(there, lab_folder) == list(misplaced_keys(found, "lab1")) == list(ended(lab_folder, ROBOTS)) == []
    assert certificates.days_left(lab_folder, ROBOTS) == pytest.approx(90.0, abs=0.1)
    assert not any("PRIVATE" in text for text in (found.authority, *(each.certificate for each in found.identities)))


INSTALL = "; `./zenpark hosts install"


def test_each_fault_has_its_remedy(lab_folder, there, tmp_path):
    assert faults_of(tmp_path / "nowhere", lab_folder)[0].startswith(f"has no certificates of KH01, CF01{INSTALL}")
    key = there / "KH01.key"
    for spoil, fault in (
        (lambda: key.chmod(0o644), f"others can read KH01.key; revoke it if they have read it{INSTALL}"),
        (key.unlink, f"KH01.key is missing{INSTALL}"),
        (lambda: shutil.copy(lab_folder / "CF01.key", key), f"KH01.key is not the key of KH01.pem{INSTALL}"),
    ):
        spoil()
        assert faults_of(there, lab_folder)[0].startswith(fault)
    shutil.copy(lab_folder / "KH01.key", there)
    (there / "CF01.pem").write_text("nonsense")
    assert faults_of(there, lab_folder)[0].startswith("CF01.key is not the key of CF01.pem")


def test_what_no_longer_counts_is_told_apart(lab_folder, there, tmp_path):
    authority.renew(lab_folder, ["KH01"])
    authority.revoke(lab_folder, ["CF01"])
    for fault, (name, fate) in zip(
        faults_of(there, lab_folder), (("KH01", "renewed"), ("CF01", "revoked")), strict=True
    ):
        assert fault.startswith(f"the certificate of {name} there has been {fate} since{INSTALL}")
    before = fingerprint((lab_folder / "ca.pem").read_text())
    authority.renew(lab_folder, authority=True)
    now = fingerprint((lab_folder / "ca.pem").read_text())
    (only,) = faults_of(there, lab_folder)
    assert f"(ca.pem {before[:12]}, here {now[:12]})" in only
    other = tmp_path / "other"
    authority.create(other, {"router": "router"})
    shutil.copy(other / "ca.pem", there)
    assert "of another lab" in faults_of(there, lab_folder)[0]
    shutil.copy(lab_folder / "ca.pem", there)
    shutil.copy(lab_folder / "lab.json", other)
    assert faults_of(there, other)[0].startswith("its certificates are of another lab")


def test_expired_certificates_and_clocks_outside_validity_are_reported(lab_folder, there):
    def renew(**more):
        authority.renew(lab_folder, ["KH01"], **more)
        for end in ("pem", "key"):
            shutil.copy(lab_folder / f"KH01.{end}", there)

    renew(days=-0.01)
    (only,) = faults_of(there, lab_folder)
    assert only.startswith("the certificate of KH01 ended at ")
    assert f"`./zenpark lab renew {lab_folder} KH01`, then `./zenpark hosts install FILE`" in only
    assert f"`./zenpark lab renew {lab_folder} KH01`" in next(ended(lab_folder, ROBOTS))
    renew()
    (first, second) = faults_of(there, lab_folder, 0.0)
    assert first.startswith("its clock says 1970-01-01 00:00 UTC, when KH01 has no valid certificate; set it (NTP)")
    assert "CF01" in second


def test_robot_outside_the_lab_cannot_be_sent(lab_folder, there):
    found = certificates.FolderContent(read_folder(there, ROBOTS).authority, read_folder(there, ["TB01"]).identities)
    assert next(faults(found, lab_folder, time.time())).startswith(
        f"TB01 is not in the lab {lab_folder}; `./zenpark lab issue"
    )
    assert next(ended(lab_folder, ["TB01"])).startswith("TB01 is not in the lab")
    (lab_folder / "CF01.key").unlink()
    assert "CF01.key is missing" in next(ended(lab_folder, ["CF01"]))
    assert "TB01" not in register(lab_folder).identities


def test_keys_of_others_do_not_belong_there(lab_folder, there):
    for name in ("KH02.key", "ca.key"):
        shutil.copy(lab_folder / name, there)
    (only,) = misplaced_keys(read_folder(there, ROBOTS), "lab1")
    assert only.startswith(
        "holds KH02.key, ca.key, which do not belong on lab1; `./zenpark hosts install FILE` removes"
    )


def test_router_is_trusted_under_its_certificates_names(lab_folder):
    assert list(unnamed(["tls/127.0.0.1:7447", "quic/localhost:1"], lab_folder)) == []
    (only,) = unnamed(["tls/192.0.2.7:7447", "quic/192.0.2.7:7448"], lab_folder)
    assert f"`./zenpark lab renew {lab_folder} router --host 192.0.2.7`" in only
    authority.renew(lab_folder, ["router"], hosts=["192.0.2.7"])
    assert list(unnamed(["tls/192.0.2.7:7447"], lab_folder)) == []


def test_two_hosts_that_are_one_folder_share_it():
    hosts = {
        "a": Host(address="pi@x", robots=["KH01"]),
        "b": Host(address="pi@x", robots=["CF01"]),
        "c": Host(address="pi@x", robots=["KH02"], lab="other"),
    }
    assert certificates.of_host("a", hosts) == certificates.of_host("b", hosts) == ["KH01", "CF01"]
    assert certificates.of_host("c", hosts) == ["KH02"]
