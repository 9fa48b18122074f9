"""Authority of a lab, its certificates on a machine, and the findings about them."""

import shutil
import stat
import time
from datetime import UTC, datetime, timedelta

import pytest
from cryptography import x509
from cryptography.x509.oid import ExtendedKeyUsageOID, NameOID

from agents.network.lab import LabError, files, register
from experiments.definition.experiment import Host
from experiments.real_time.hosts import authority, certificates
from experiments.real_time.hosts.certificates import ended, faults, fingerprint, misplaced_keys, read_folder, unnamed
from tests.commands import invoke

ROBOTS = ["KH01", "CF01"]
ROLES = {"router": "router", "operator": "operator", **dict.fromkeys([*ROBOTS, "KH02"], "robot")}


@pytest.fixture
def lab(tmp_path):
    authority.create(tmp_path / "lab", ROLES, hosts=["192.0.2.7", "lab.example.org"], days=30.0)
    return tmp_path / "lab"


def certificate(lab, name):
    return x509.load_pem_x509_certificate((lab / f"{name}.pem").read_bytes())


def common_name(lab, name):
    return certificate(lab, name).subject.get_attributes_for_oid(NameOID.COMMON_NAME)[0].value


def extension(lab, name, kind):
    return certificate(lab, name).extensions.get_extension_for_class(kind).value


def names_of(lab, name, kind=x509.IPAddress):
    return [*map(str, extension(lab, name, x509.SubjectAlternativeName).get_values_for_type(kind))]


def days_left(made):
    return (made.not_valid_after_utc - datetime.now(UTC)) / timedelta(days=1.0)


def install(lab, there, name):
    for end in ("pem", "key"):
        shutil.copy(lab / f"{name}.{end}", there)


def test_certificate_says_who_until_when_and_who_vouches(lab):
    assert extension(lab, "ca", x509.BasicConstraints) == x509.BasicConstraints(ca=True, path_length=0)
    for name in ROLES:
        made, known = certificate(lab, name), register(lab).identities[name]
        made.verify_directly_issued_by(certificate(lab, "ca"))
        assert (common_name(lab, name), made.public_key().curve.name) == (name, "secp256r1")
        assert 29.9 < days_left(made) < 30.0
        assert int(known.serial, 16) == made.serial_number
        assert datetime.fromisoformat(known.until) == made.not_valid_after_utc
        assert not extension(lab, name, x509.BasicConstraints).ca
        assert stat.S_IMODE((lab / f"{name}.key").stat().st_mode) == 0o600
    assert stat.S_IMODE(lab.stat().st_mode) == 0o700
    assert [file.name for file in lab.glob(".*")] == [".gitignore"], "nothing half-written is left"


def test_only_who_listens_can_pose_as_a_router(lab):
    client, server = ExtendedKeyUsageOID.CLIENT_AUTH, ExtendedKeyUsageOID.SERVER_AUTH
    authority.issue(lab, {"TB01": "robot"}, hosts=["192.0.2.9"])
    authority.issue(lab, {"TB02": "robot"})
    listening = {"router": ["127.0.0.1", "::1", "192.0.2.7"], "TB01": ["192.0.2.9"]}
    for name in (*ROLES, "TB01", "TB02"):
        purposes = {client, server} if name in listening else {client}
        assert {*extension(lab, name, x509.ExtendedKeyUsage)} == purposes, name
    assert {name: names_of(lab, name) for name in listening} == listening
    assert names_of(lab, "router", x509.DNSName) == ["localhost", "lab.example.org"]


def test_revoking_moves_the_name_and_renewing_keeps_it(lab):
    before = (lab / "CF01.key").read_bytes()
    for name in ("CF01.2", "CF01.3"):
        authority.revoke(lab, ["CF01"])
        assert common_name(lab, "CF01") == register(lab).identities["CF01"].common_name == name
    assert (lab / "CF01.key").read_bytes() != before
    serial = register(lab).identities["CF01"].serial
    authority.renew(lab, ["CF01"], days=60.0)
    assert [common_name(lab, name) for name in ROBOTS] == ["KH01", "CF01.3"]
    assert register(lab).identities["CF01"].serial != serial
    assert 59.9 < days_left(certificate(lab, "CF01")) < 60.0


def test_a_router_can_be_given_another_address(lab):
    assert list(unnamed(["tls/127.0.0.1:7447", "quic/localhost:1", "tls/192.0.2.7:1"], lab)) == []
    (only,) = unnamed(["tls/192.0.2.99:7447", "quic/192.0.2.99:7448"], lab)
    assert f"`./zenpark lab renew {lab} router --host 192.0.2.99`" in only
    authority.renew(lab, ["router"], hosts=["192.0.2.99"])
    assert list(unnamed(["tls/192.0.2.99:7447"], lab)) == []
    for identities in (register(lab).identities, authority.renew(lab).identities):
        assert {"192.0.2.7", "192.0.2.99", "127.0.0.1"} <= set(identities["router"].hosts)
    with pytest.raises(LabError, match="only routers need --host"):
        authority.renew(lab, hosts=["192.0.2.99"])


def test_a_new_authority_signs_everybody_anew(lab):
    before = certificate(lab, "ca")
    authority.renew(lab, authority=True)
    after = certificate(lab, "ca")
    assert after.subject != before.subject
    for name in ROLES:
        certificate(lab, name).verify_directly_issued_by(after)
        files(lab, name)
    with pytest.raises(LabError, match="give no name with --authority"):
        authority.renew(lab, ["CF01"], authority=True)


@pytest.mark.parametrize("name", ["a laboratory with a name that goes on and on, for as long as it likes", "Löwe " * 9])
def test_no_certificate_outlives_the_authority(tmp_path, name):
    authority.create(tmp_path / name, {"CF01": "robot"}, days=2.0 * authority.AUTHORITY_DAYS)
    end = certificate(tmp_path / name, "ca").not_valid_after_utc
    assert certificate(tmp_path / name, "CF01").not_valid_after_utc == end
    assert len(common_name(tmp_path / name, "ca")) <= 64


def test_what_cannot_be_done_is_said(lab, tmp_path):
    with pytest.raises(LabError, match="is a lab already"):
        authority.create(lab, ROLES)
    with pytest.raises(LabError, match="CF01: in the lab already"):
        authority.issue(lab, {"CF01": "robot"})
    with pytest.raises(LabError, match="CF07: not in this lab, which knows router, operator, KH01, CF01, KH02"):
        authority.revoke(lab, ["CF07"])
    for name in ("ca", "a/b", "", "../x", "é", "1a", "CF01.2"):
        with pytest.raises(LabError, match="cannot be an identity"):
            authority.issue(lab, {name: "robot"})
    for host in ("a b", "lab_1.org", "300.1.1.1.1;", "*"):
        with pytest.raises(LabError, match="neither a host's name nor an address"):
            authority.issue(lab, {"TB01": "robot"}, hosts=[host])
    assert not (lab / "TB01.pem").exists()
    (lab / "ca.key").rename(tmp_path / "away.key")
    with pytest.raises(LabError, match="where the authority of the lab is kept"):
        authority.renew(lab)


@pytest.mark.slow
def test_the_commands(tmp_path):
    lab = tmp_path / "lab"
    first = invoke("lab", "init", lab, "robotic-park", "KH09", "--host", "192.0.2.7", "--days", "10")
    assert {"TB01", "KH03", "CF02", "KH09", "observer", "operator"} < register(lab).identities.keys()
    assert "10 days left  renew it  listens at localhost, 127.0.0.1, ::1, 192.0.2.7" in first.stdout
    invoke("lab", "issue", lab, "ana", "--role", "operator")
    assert register(lab).identities["ana"].role == "operator"
    revoked = invoke("lab", "revoke", lab, "ana").stdout
    assert revoked.count("as ana.2") == 1
    assert "A zenohd notices nothing" in revoked
    invoke("lab", "renew", lab, "--authority")
    invoke("lab", "show", lab)
    assert '"ana.2"' in invoke("lab", "show", lab, "--json").stdout
    for wrong in (("init", tmp_path / "b", "router"), ("issue", lab, "bob", "--role", "operater")):
        assert isinstance(invoke("lab", *wrong, code=None).exception, LabError)


def test_an_ended_certificate_is_shown(tmp_path):
    authority.create(tmp_path / "lab", {"CF01": "robot"}, days=-0.01)
    assert "ENDED" in invoke("lab", "show", tmp_path / "lab", code=1).stdout


@pytest.fixture
def there(lab, tmp_path):
    """A machine's folder with what belongs there."""
    folder = tmp_path / "there"
    folder.mkdir(mode=0o700)
    shutil.copy(lab / "ca.pem", folder)
    for robot in ROBOTS:
        install(lab, folder, robot)
    return folder


def faults_of(there, lab, clock=None):
    return list(faults(read_folder(there, ROBOTS), lab, time.time() if clock is None else clock))


INSTALL = "; `./zenpark hosts install"


def test_each_fault_has_its_remedy(lab, there, tmp_path):
    assert faults_of(tmp_path / "nowhere", lab)[0].startswith(f"has no certificates of KH01, CF01{INSTALL}")
    key = there / "KH01.key"
    for spoil, fault in (
        (lambda: key.chmod(0o644), f"others can read KH01.key; revoke it if they have read it{INSTALL}"),
        (key.unlink, f"KH01.key is missing{INSTALL}"),
        (lambda: shutil.copy(lab / "CF01.key", key), f"KH01.key is not the key of KH01.pem{INSTALL}"),
    ):
        spoil()
        assert faults_of(there, lab)[0].startswith(fault)
    shutil.copy(lab / "KH01.key", there)
    (there / "CF01.pem").write_text("nonsense")
    assert faults_of(there, lab)[0].startswith("CF01.key is not the key of CF01.pem")


def test_what_no_longer_counts_is_told_apart(lab, there, tmp_path):
    authority.renew(lab, ["KH01"])
    authority.revoke(lab, ["CF01"])
    fates = (("KH01", "renewed"), ("CF01", "revoked"))
    for fault, (name, fate) in zip(faults_of(there, lab), fates, strict=True):
        assert fault.startswith(f"the certificate of {name} there has been {fate} since{INSTALL}")
    before = fingerprint((lab / "ca.pem").read_text())
    authority.renew(lab, authority=True)
    now = fingerprint((lab / "ca.pem").read_text())
    (only,) = faults_of(there, lab)
    assert f"(ca.pem {before[:12]}, here {now[:12]})" in only
    other = tmp_path / "other"
    authority.create(other, {"router": "router"})
    shutil.copy(other / "ca.pem", there)
    assert "of another lab" in faults_of(there, lab)[0]
    shutil.copy(lab / "ca.pem", there)
    shutil.copy(lab / "lab.json", other)
    assert faults_of(there, other)[0].startswith("its certificates are of another lab")


def test_expired_certificates_and_clocks_outside_validity_are_reported(lab, there):
    authority.renew(lab, ["KH01"], days=-0.01)
    install(lab, there, "KH01")
    (only,) = faults_of(there, lab)
    assert only.startswith("the certificate of KH01 ended at ")
    assert f"`./zenpark lab renew {lab} KH01`, then `./zenpark hosts install FILE`" in only
    assert f"`./zenpark lab renew {lab} KH01`" in next(ended(lab, ROBOTS))
    authority.renew(lab, ["KH01"])
    install(lab, there, "KH01")
    first, second = faults_of(there, lab, 0.0)
    assert first.startswith("its clock says 1970-01-01 00:00 UTC, when KH01 has no valid certificate; set it (NTP)")
    assert "CF01" in second


def test_keys_of_others_do_not_belong_there(lab, there):
    found = read_folder(there, ROBOTS)
    assert faults_of(there, lab) == list(misplaced_keys(found, "lab1")) == list(ended(lab, ROBOTS)) == []
    assert certificates.days_left(lab, ROBOTS) == pytest.approx(30.0, abs=0.1)
    assert not any("PRIVATE" in text for text in (found.authority, *(each.certificate for each in found.identities)))
    for name in ("KH02.key", "ca.key"):
        shutil.copy(lab / name, there)
    (only,) = misplaced_keys(read_folder(there, ROBOTS), "lab1")
    assert only.startswith("holds KH02.key, ca.key, which do not belong on lab1; `./zenpark hosts install FILE` rem")
    found = certificates.FolderContent(found.authority, read_folder(there, ["TB01"]).identities)
    outside = f"TB01 is not in the lab {lab}; `./zenpark lab issue"
    assert next(faults(found, lab, time.time())).startswith(outside)
    assert next(ended(lab, ["TB01"])).startswith("TB01 is not in the lab")
    (lab / "CF01.key").unlink()
    assert "CF01.key is missing" in next(ended(lab, ["CF01"]))


def test_two_hosts_that_are_one_folder_share_it():
    labs = {"a": ("KH01", "here"), "b": ("CF01", "here"), "c": ("KH02", "other")}
    hosts = {name: Host(address="pi@x", robots=[robot], lab=lab) for name, (robot, lab) in labs.items()}
    assert certificates.of_host("a", hosts) == certificates.of_host("b", hosts) == ["KH01", "CF01"]
    assert certificates.of_host("c", hosts) == ["KH02"]
