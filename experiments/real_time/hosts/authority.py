"""A lab's certificate authority: makes, renews and revokes the certificates of robots and people.

Keys are of the curve P-256. Certificates carry a name as their common name, by which a router finds the rights. Only
listening members get a certificate that is valid for a router; a robot's is for connecting. Zenoh reads no revocation
lists. What counts here is the register: a router gives rights to the common name that stands in it, and `revoke` moves
that on, from `CF01` to `CF01.2`. The old key still opens a connection, in which nothing is allowed. A new authority
(`renew --authority`) ends that as well, at the price of new files for all members.
"""

from __future__ import annotations

import ipaddress
import os
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Final

import msgspec
from cryptography import x509
from cryptography.exceptions import UnsupportedAlgorithm
from cryptography.hazmat.primitives import hashes, serialization
from cryptography.hazmat.primitives.asymmetric import ec
from cryptography.x509.oid import ExtendedKeyUsageOID, NameOID

from agents.network.lab import AUTHORITY, REGISTER, ROLES, Identity, LabError, Register, Role, check_path, register

Key = ec.EllipticCurvePrivateKey
SERVICES: Final[tuple[Role, ...]] = tuple(role for role in ROLES if role != "robot")
HERE: Final = ("localhost", "127.0.0.1", "::1")
DAYS: Final = 90.0  # life of a certificate
AUTHORITY_DAYS: Final = 1826.0  # five years
MOST_OF_NAME: Final = 24  # characters of a lab's name in its certificate; a common name holds 64
CLOCKS: Final = timedelta(hours=1)  # how far a robot's clock may be behind


@dataclass(frozen=True)
class Authority:
    """The signing authority, opened from the folder of a lab."""

    folder: Path
    certificate: x509.Certificate
    key: Key


def create(
    folder: Path,
    identities: Mapping[str, Role],
    *,
    hosts: Sequence[str] = (),
    listening: Mapping[str, Sequence[str]] | None = None,
    days: float = DAYS,
) -> Register:
    """Make a lab: its folder, its authority, and a certificate for each identity.

    `identities` are roles by name. `hosts` are names and addresses of the routers, beside this machine; `listening`
    those of other members that listen, by name: of a mesh. Raises LabError if the folder holds a lab or cannot be
    written, or its path, a name or an address is wrong.
    """
    check_path(folder)
    if (folder / REGISTER).exists() or (folder / f"{AUTHORITY}.key").exists():
        raise LabError(
            f"{folder} is a lab already: `./zenpark lab issue {folder} NAME...` adds identities, "
            "renew and revoke change them"
        )
    try:
        folder.mkdir(mode=0o700, parents=True, exist_ok=True)
        folder.chmod(0o700)
        (folder / ".gitignore").write_text("*\n", encoding="utf-8")  # keys never go into a repository
    except OSError as error:
        raise LabError(f"{folder}: cannot be made: {error.strerror}") from None
    for host in hosts:
        _alternative(host)
    authority = _found(folder)
    wanted = {
        name: Identity(role, name, "", "", [*(hosts if role == "router" else ()), *(listening or {}).get(name, ())])
        for name, role in identities.items()
    }
    return _issued(authority, Register({}), wanted, days=days)


def issue(folder: Path, identities: Mapping[str, Role], *, hosts: Sequence[str] = (), days: float = DAYS) -> Register:
    """Add identities to a lab. With `hosts` they may listen there, as a router does.

    Raises LabError if one is there already, or the authority's key is not on this machine.
    """
    known = register(folder)
    if present := [name for name in identities if name in known.identities]:
        raise LabError(f"{', '.join(present)}: in the lab already; `./zenpark lab renew` or `revoke` makes new files")
    return _issued(_opened(folder), known, {name: Identity(role, name, "", "") for name, role in identities.items()},
                   hosts=hosts, days=days)  # fmt: skip


def renew(
    folder: Path, names: Sequence[str] = (), *, hosts: Sequence[str] = (), days: float = DAYS, authority: bool = False
) -> Register:
    """Make new keys and certificates on the same names; those before stay valid until they end.

    All are renewed if none is named, and with a new `authority`: from then on only its certificates count. `hosts` are
    names and addresses at which those named may listen from now on, beside those from before. Raises LabError if there
    is no such identity, or the authority's key is not on this machine.
    """
    known = register(folder)
    if authority and names:
        raise LabError("a new authority signs all certificates again: give no name with --authority")
    if hosts and not names:
        raise LabError("only routers need --host: name them, as in `./zenpark lab renew LAB router --host ADDRESS`")
    signing = _found(folder) if authority else _opened(folder)
    return _issued(signing, known, _named(known, names or list(known.identities)), hosts=hosts, days=days)


def revoke(folder: Path, names: Sequence[str], *, days: float = DAYS) -> Register:
    """Take all rights from the present certificates of identities, and make them new ones.

    Raises LabError if there is no such identity, or the authority's key is not on this machine.
    """
    known = register(folder)
    moved = {}
    for name, identity in _named(known, names).items():
        number = 1 if identity.common_name == name else int(identity.common_name.removeprefix(f"{name}."))
        moved[name] = msgspec.structs.replace(identity, common_name=f"{name}.{number + 1}")
    return _issued(_opened(folder), known, moved, days=days)


def _named(known: Register, names: Iterable[str]) -> dict[str, Identity]:
    if strangers := [name for name in names if name not in known.identities]:
        raise LabError(f"{', '.join(strangers)}: not in this lab, which knows {', '.join(known.identities)}")
    return {name: known.identities[name] for name in names}


def _found(folder: Path) -> Authority:
    """A new authority, written to the folder of its lab."""
    key = ec.generate_private_key(ec.SECP256R1())
    now = datetime.now(UTC)
    # a name of its own: with that of the one before, which of the two signed would be found out by trying
    title = f"zenpark {folder.name[:MOST_OF_NAME]} {now:%Y-%m-%d %H:%M:%S.%f}"
    name = x509.Name([x509.NameAttribute(NameOID.COMMON_NAME, title)])
    builder = _builder(name, name, key, now, now + timedelta(days=AUTHORITY_DAYS), signs=True)
    certificate = builder.sign(key, hashes.SHA256())
    _write_pair(folder / AUTHORITY, key, certificate)
    return Authority(folder, certificate, key)


def _opened(folder: Path) -> Authority:
    file = folder / f"{AUTHORITY}.key"
    try:
        key = serialization.load_pem_private_key(file.read_bytes(), None)
        certificate = x509.load_pem_x509_certificate((folder / f"{AUTHORITY}.pem").read_bytes())
    except OSError as error:
        raise LabError(f"{error.filename}: {error.strerror}; do this where the authority of the lab is kept") from None
    except (ValueError, TypeError, UnsupportedAlgorithm) as error:
        raise LabError(f"{file}: is no key of a lab: {error}") from None
    if not isinstance(key, Key):
        raise LabError(f"{file}: is no key of a lab: it is not of an elliptic curve")
    return Authority(folder, certificate, key)


def _issued(
    authority: Authority, known: Register, identities: Mapping[str, Identity], *, hosts: Sequence[str] = (), days: float
) -> Register:
    """Write a key and a certificate for each identity, and last the register, which makes them count."""
    for name in identities:
        if name == AUTHORITY or not (name.isascii() and name.isidentifier() and name[0] != "_"):
            raise LabError(f"'{name}' cannot be an identity: write letters, digits and _, beginning with a letter")
    for host in hosts:
        _alternative(host)
    made = dict(known.identities)
    for name, identity in identities.items():
        reached = list(dict.fromkeys([*identity.hosts, *hosts]))
        if identity.role == "router":
            reached = list(dict.fromkeys([*HERE, *reached]))
        made[name] = _certified(authority, name, msgspec.structs.replace(identity, hosts=reached), days)
    whole = Register(made)
    _write(authority.folder / REGISTER, msgspec.json.format(msgspec.json.encode(whole), indent=1) + b"\n", 0o644)
    return whole


def _certified(authority: Authority, name: str, identity: Identity, days: float) -> Identity:
    key = ec.generate_private_key(ec.SECP256R1())
    now = datetime.now(UTC)
    end = min(now + timedelta(days=days), authority.certificate.not_valid_after_utc)
    purposes = [ExtendedKeyUsageOID.CLIENT_AUTH, *([ExtendedKeyUsageOID.SERVER_AUTH] if identity.hosts else [])]
    subject = x509.Name([x509.NameAttribute(NameOID.COMMON_NAME, identity.common_name)])
    builder = _builder(subject, authority.certificate.subject, key, min(now, end), end, signs=False)
    builder = builder.add_extension(x509.ExtendedKeyUsage(purposes), critical=False)
    if identity.hosts:
        names = x509.SubjectAlternativeName([_alternative(host) for host in identity.hosts])
        builder = builder.add_extension(names, critical=False)
    certificate = builder.sign(authority.key, hashes.SHA256())
    _write_pair(authority.folder / name, key, certificate)
    until = end.isoformat(timespec="seconds")
    return msgspec.structs.replace(identity, serial=f"{certificate.serial_number:x}", until=until)


def _builder(
    subject: x509.Name, issuer: x509.Name, key: Key, begin: datetime, end: datetime, *, signs: bool
) -> x509.CertificateBuilder:
    """A certificate of the authority itself, which `signs` others, or of an identity."""
    others = ("content_commitment", "key_encipherment", "data_encipherment", "key_agreement")
    unused = dict.fromkeys((*others, "encipher_only", "decipher_only"), False)
    usage = x509.KeyUsage(digital_signature=not signs, key_cert_sign=signs, crl_sign=signs, **unused)
    return (
        x509.CertificateBuilder()
        .subject_name(subject)
        .issuer_name(issuer)
        .public_key(key.public_key())
        .serial_number(x509.random_serial_number())
        .not_valid_before(begin - CLOCKS)
        .not_valid_after(end)
        .add_extension(x509.BasicConstraints(ca=signs, path_length=0 if signs else None), critical=True)
        .add_extension(usage, critical=True)
    )


def _alternative(host: str) -> x509.GeneralName:
    """A name or address as it stands in a certificate."""
    try:
        return x509.IPAddress(ipaddress.ip_address(host))
    except ValueError:
        pass
    if not host.isascii() or not all(part.replace("-", "").isalnum() for part in host.split(".")):
        raise LabError(f"'{host}' is neither a host's name nor an address: write 192.168.0.10 or lab.example.org")
    return x509.DNSName(host)


def _write_pair(place: Path, key: Key, certificate: x509.Certificate) -> None:
    """Write a key and its certificate."""
    pem, plain = serialization.Encoding.PEM, serialization.NoEncryption()
    secret = key.private_bytes(pem, serialization.PrivateFormat.PKCS8, plain)
    _write(place.with_name(f"{place.name}.key"), secret, 0o600)
    _write(place.with_name(f"{place.name}.pem"), certificate.public_bytes(pem), 0o644)


def _write(file: Path, content: bytes, mode: int) -> None:
    """Write a file at once and whole, with its permissions from the beginning."""
    beside = file.with_name(f".{file.name}.new")
    try:
        beside.unlink(missing_ok=True)
        with open(os.open(beside, os.O_WRONLY | os.O_CREAT | os.O_EXCL, mode), "wb") as target:  # noqa: PTH123 - of a descriptor
            target.write(content)
        beside.replace(file)
    except OSError as error:
        raise LabError(f"{file}: cannot be written: {error.strerror}") from None
