import stat
from datetime import UTC, datetime, timedelta

import pytest
from cryptography import x509
from cryptography.x509.oid import ExtendedKeyUsageOID, NameOID

from agents.network.lab import LabError, files, register
from experiments.real_time.hosts import authority
from tests.commands import invoke

ROBOTS = {"router": "router", "operator": "operator", "CF01": "robot", "CF02": "robot"}


@pytest.fixture
def new_lab(tmp_path):
    authority.create(tmp_path / "lab", ROBOTS, hosts=["192.0.2.7", "lab.example.org"], days=30.0)
    return tmp_path / "lab"


def certificate(new_lab, name):
    return x509.load_pem_x509_certificate((new_lab / f"{name}.pem").read_bytes())


def common_name(new_lab, name):
    return certificate(new_lab, name).subject.get_attributes_for_oid(NameOID.COMMON_NAME)[0].value


def extension(made, kind):
    return made.extensions.get_extension_for_class(kind).value


def purposes(new_lab, name):
    return set(extension(certificate(new_lab, name), x509.ExtendedKeyUsage))


def names_of(new_lab, name, kind):
    return [
        str(each)
        for each in extension(certificate(new_lab, name), x509.SubjectAlternativeName).get_values_for_type(kind)
    ]


def days_left(made):
    return (made.not_valid_after_utc - datetime.now(UTC)) / timedelta(days=1.0)


def test_certificate_says_who_until_when_and_who_vouches(new_lab):
    ca = certificate(new_lab, "ca")
    assert extension(ca, x509.BasicConstraints) == x509.BasicConstraints(ca=True, path_length=0)
    for name in ROBOTS:
        made = certificate(new_lab, name)
        made.verify_directly_issued_by(ca)
        assert common_name(new_lab, name) == name
        assert made.public_key().curve.name == "secp256r1"
        assert 29.9 < days_left(made) < 30.0
        known = register(new_lab).identities[name]
        assert int(known.serial, 16) == made.serial_number
        assert datetime.fromisoformat(known.until) == made.not_valid_after_utc
        assert not extension(made, x509.BasicConstraints).ca


@pytest.mark.parametrize("name", ["a laboratory with a name that goes on and on, for as long as it likes", "Löwe " * 9])
def test_a_lab_may_have_a_long_name(tmp_path, name):
    authority.create(tmp_path / name, ROBOTS, hosts=[], days=30.0)
    assert len(common_name(tmp_path / name, "ca")) <= 64


def test_only_who_listens_can_pose_as_a_router(new_lab):
    client, server = ExtendedKeyUsageOID.CLIENT_AUTH, ExtendedKeyUsageOID.SERVER_AUTH
    assert purposes(new_lab, "router") == {client, server}
    assert names_of(new_lab, "router", x509.DNSName) == ["localhost", "lab.example.org"]
    assert names_of(new_lab, "router", x509.IPAddress) == ["127.0.0.1", "::1", "192.0.2.7"]
    for name in set(ROBOTS) - {"router"}:
        assert purposes(new_lab, name) == {client}
    authority.issue(new_lab, {"KH01": "robot"}, hosts=["192.0.2.9"])
    assert server in purposes(new_lab, "KH01")
    assert names_of(new_lab, "KH01", x509.IPAddress) == ["192.0.2.9"]
    authority.issue(new_lab, {"KH02": "robot"})
    assert purposes(new_lab, "KH02") == {client}


def test_keys_are_for_their_owner_alone(new_lab):
    assert stat.S_IMODE(new_lab.stat().st_mode) == 0o700
    for key in new_lab.glob("*.key"):
        assert stat.S_IMODE(key.stat().st_mode) == 0o600
    assert [file.name for file in new_lab.glob(".*")] == [".gitignore"], "nothing half-written is left"


def test_revoking_moves_the_name_that_counts(new_lab):
    before = (new_lab / "CF01.key").read_bytes()
    authority.revoke(new_lab, ["CF01"])
    assert common_name(new_lab, "CF01") == register(new_lab).identities["CF01"].common_name == "CF01.2"
    assert (new_lab / "CF01.key").read_bytes() != before
    authority.revoke(new_lab, ["CF01"])
    assert common_name(new_lab, "CF01") == "CF01.3"
    assert common_name(new_lab, "CF02") == "CF02"


def test_renewing_keeps_the_name(new_lab):
    authority.revoke(new_lab, ["CF01"])
    serial = register(new_lab).identities["CF01"].serial
    authority.renew(new_lab, ["CF01"], days=60.0)
    assert common_name(new_lab, "CF01") == "CF01.2"
    assert register(new_lab).identities["CF01"].serial != serial
    assert 59.9 < days_left(certificate(new_lab, "CF01")) < 60.0
    assert "192.0.2.7" in authority.renew(new_lab).identities["router"].hosts


def test_a_router_can_be_given_another_address(new_lab):
    authority.renew(new_lab, ["router"], hosts=["192.0.2.99"])
    assert {"192.0.2.7", "192.0.2.99", "127.0.0.1"} <= set(register(new_lab).identities["router"].hosts)
    with pytest.raises(LabError, match="only routers need --host"):
        authority.renew(new_lab, hosts=["192.0.2.99"])


def test_a_new_authority_signs_everybody_anew(new_lab):
    before = certificate(new_lab, "ca")
    authority.renew(new_lab, authority=True)
    after = certificate(new_lab, "ca")
    assert after.subject != before.subject
    for name in ROBOTS:
        certificate(new_lab, name).verify_directly_issued_by(after)
        files(new_lab, name)
    with pytest.raises(LabError, match="give no name with --authority"):
        authority.renew(new_lab, ["CF01"], authority=True)


def test_no_certificate_outlives_the_authority(tmp_path):
    authority.create(tmp_path / "lab", {"CF01": "robot"}, days=2.0 * authority.AUTHORITY_DAYS)
    end = certificate(tmp_path / "lab", "ca").not_valid_after_utc
    assert certificate(tmp_path / "lab", "CF01").not_valid_after_utc == end


def test_what_cannot_be_done_is_said(new_lab, tmp_path):
    for act, reason in (
        (lambda: authority.create(new_lab, ROBOTS), "is a lab already"),
        (lambda: authority.issue(new_lab, {"CF01": "robot"}), "CF01: in the lab already"),
        (
            lambda: authority.revoke(new_lab, ["CF07"]),
            "CF07: not in this lab, which knows router, operator, CF01, CF02",
        ),
    ):
        with pytest.raises(LabError, match=reason):
            act()
    for name in ("ca", "a/b", "", "../x", "é", "1a", "CF01.2"):
        with pytest.raises(LabError, match="cannot be an identity"):
            authority.issue(new_lab, {name: "robot"})
    for host in ("a b", "lab_1.org", "300.1.1.1.1;", "*"):
        with pytest.raises(LabError, match="neither a host's name nor an address"):
            authority.issue(new_lab, {"KH01": "robot"}, hosts=[host])
    assert not (new_lab / "KH01.pem").exists()
    (new_lab / "ca.key").rename(tmp_path / "away.key")
    with pytest.raises(LabError, match="where the authority of the lab is kept"):
        authority.renew(new_lab)


@pytest.mark.slow
def test_the_commands(tmp_path):
    new_lab = tmp_path / "lab"
    first = invoke("lab", "init", new_lab, "robotic-park", "KH09", "--host", "192.0.2.7", "--days", "10")
    assert {"TB01", "KH03", "CF02", "KH09", "observer", "operator"} < register(new_lab).identities.keys()
    assert "10 days left  renew it  listens at localhost, 127.0.0.1, ::1, 192.0.2.7" in first.stdout
    assert "zenpark run FILE --lab" in first.stdout
    invoke("lab", "issue", new_lab, "ana", "--role", "operator")
    assert register(new_lab).identities["ana"].role == "operator"
    revoked = invoke("lab", "revoke", new_lab, "ana").stdout
    assert revoked.count("as ana.2") == 1
    assert "A zenohd notices nothing" in revoked
    invoke("lab", "renew", new_lab, "--authority")
    invoke("lab", "show", new_lab)
    assert '"ana.2"' in invoke("lab", "show", new_lab, "--json").stdout
    for wrong in (("init", tmp_path / "b", "router"), ("issue", new_lab, "bob", "--role", "operater")):
        assert isinstance(invoke("lab", *wrong, code=None).exception, LabError)


def test_an_ended_certificate_is_shown(tmp_path):
    authority.create(tmp_path / "lab", {"CF01": "robot"}, days=-0.01)
    assert "ENDED" in invoke("lab", "show", tmp_path / "lab", code=1).stdout
