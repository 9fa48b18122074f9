"""A lab's certificates on other machines: their content, problems and remedies.

A station reports the content of its folder; only certificates leave it, which are public. The machine that starts the
run compares them with the register of the lab. Private keys go one way, over ssh, with `./zenpark hosts install`.
"""

from __future__ import annotations

import hashlib
import ssl
import stat
from collections.abc import Iterator, Mapping, Sequence
from datetime import UTC, datetime
from pathlib import Path
from typing import TYPE_CHECKING, Final

import msgspec

from agents.network.endpoints import Endpoint
from agents.network.lab import AUTHORITY, LabError, Register, files, register

if TYPE_CHECKING:
    from experiments.definition.experiment import Host

INSTALL: Final = "`./zenpark hosts install FILE` puts the right ones there"
FINGERPRINT_DIGITS: Final = 12  # digits of a fingerprint, for people


class IdentityFiles(msgspec.Struct, frozen=True, omit_defaults=True):
    """An identity on a machine: its certificate (PEM, "" if there is none), and what is wrong with its files."""

    name: str
    certificate: str = ""
    wrong: str = ""


class FolderContent(msgspec.Struct, frozen=True, omit_defaults=True):
    """Content of a folder: its authority (PEM), the requested identities, and keys of others."""

    authority: str = ""
    identities: list[IdentityFiles] = []
    others: list[str] = []


def read_folder(folder: Path, names: Sequence[str]) -> FolderContent:
    """Content of a folder on this machine, of the identities `names`."""
    return FolderContent(
        _text(folder / f"{AUTHORITY}.pem"),
        [IdentityFiles(name, _text(folder / f"{name}.pem"), _wrong(folder, name)) for name in names],
        sorted(file.stem for file in folder.glob("*.key") if file.stem not in names),
    )


def _text(file: Path) -> str:
    try:
        return file.read_text("ascii")
    except (OSError, UnicodeDecodeError):
        return ""


def _wrong(folder: Path, name: str) -> str:
    certificate, key = folder / f"{name}.pem", folder / f"{name}.key"
    for file in (certificate, key):
        if not file.is_file():
            return f"{file.name} is missing"
    if stat.S_IMODE(key.stat().st_mode) & 0o077:
        return f"others can read {key.name}; revoke it if they have read it"
    try:
        ssl.SSLContext(ssl.PROTOCOL_TLS_CLIENT).load_cert_chain(certificate, key, lambda: b"")
    except OSError:  # ssl.SSLError is one
        return f"{key.name} is not the key of {certificate.name}"
    return ""


def fingerprint(certificate: str) -> str:
    """SHA-256 of a certificate (PEM), in hexadecimal; "none" if it is no certificate."""
    try:
        return hashlib.sha256(ssl.PEM_cert_to_DER_cert(certificate)).hexdigest()
    except ValueError:
        return "none"


def of_host(name: str, hosts: Mapping[str, Host]) -> list[str]:
    """Robots with certificates in a host's folder, including those of hosts that share the folder."""
    place = hosts[name].address, hosts[name].lab
    return [robot for host in hosts.values() if (host.address, host.lab) == place for robot in host.robots]


def ended(folder: Path, names: Sequence[str]) -> Iterator[str]:
    """Reasons why identities of a lab on this machine cannot be sent, each with its remedy."""
    known = register(folder)
    for name in names:
        if why := _of_register(known, folder, name):
            yield why
            continue
        try:
            files(folder, name)
        except LabError as error:
            yield str(error)


def _of_register(known: Register, folder: Path, name: str) -> str:
    """Fault of an identity by the register, with the remedy; empty if it may have a certificate that counts."""
    if name not in known.identities:
        return f"{name} is not in the lab {folder}; `./zenpark lab issue {folder} {name}`"
    until = datetime.fromisoformat(known.identities[name].until)
    if until < datetime.now(UTC):
        return f"the certificate of {name} ended at {until:%Y-%m-%d %H:%M}; `./zenpark lab renew {folder} {name}`"
    return ""


def days_left(folder: Path, names: Sequence[str]) -> float:
    """Time until the first of some certificates ends [days], by the register."""
    known = register(folder).identities
    ends = [datetime.fromisoformat(known[name].until) for name in names if name in known]
    return (min(ends) - datetime.now(UTC)).total_seconds() / 86400.0 if ends else 0.0


def faults(found: FolderContent, folder: Path, host_utc: float) -> Iterator[str]:
    """Faults of the certificates of a machine with its clock at `host_utc` [s, UTC], each with its remedy.

    `folder` is that of the lab on this machine, with its register and `ca.pem`.
    """
    from cryptography import x509  # noqa: PLC0415 - 4.5 MB that runs without a lab do without

    names = ", ".join(each.name for each in found.identities)
    if not found.authority:
        yield f"has no certificates of {names}; {INSTALL}"
        return
    found_print, own_print = fingerprint(found.authority), fingerprint(_text(folder / f"{AUTHORITY}.pem"))
    if found_print != own_print:
        yield (
            f"its certificates are of another lab, or of an authority that has been renewed since (ca.pem "
            f"{found_print[:FINGERPRINT_DIGITS]}, here {own_print[:FINGERPRINT_DIGITS]}); {INSTALL}"
        )
        return
    known = register(folder)
    for each in found.identities:
        if why := _of_register(known, folder, each.name):
            yield f"{why}, then {INSTALL}"
            continue
        if each.wrong:
            yield f"{each.wrong}; {INSTALL}"
            continue
        try:
            certificate = x509.load_pem_x509_certificate(each.certificate.encode())
        except ValueError:
            yield f"{each.name}.pem is no certificate; {INSTALL}"
            continue
        registered = known.identities[each.name]
        if f"{certificate.serial_number:x}" != registered.serial:
            same = any(attribute.value == registered.common_name for attribute in certificate.subject)
            what = "renewed" if same else "revoked"
            yield f"the certificate of {each.name} there has been {what} since; {INSTALL}"
        elif not certificate.not_valid_before_utc.timestamp() < host_utc < certificate.not_valid_after_utc.timestamp():
            now = datetime.fromtimestamp(host_utc, UTC)
            yield f"its clock says {now:%Y-%m-%d %H:%M} UTC, when {each.name} has no valid certificate; set it (NTP)"


def unnamed(endpoints: Sequence[str], folder: Path) -> Iterator[str]:
    """Reasons why robots would refuse a router: its certificate must name the address by which they reach it."""
    routers = [each for each in register(folder).identities.values() if each.role == "router"]
    named = {host for router in routers for host in router.hosts}
    for reached in dict.fromkeys(Endpoint.parse(endpoint).host for endpoint in endpoints):
        if reached not in named:
            yield (
                f"reaches the router at {reached}, which stands in no router's certificate; "
                f"`./zenpark lab renew {folder} router --host {reached}` adds it"
            )


def misplaced_keys(found: FolderContent, host: str) -> Iterator[str]:
    """Keys that do not belong to a machine, with the remedy."""
    if found.others:
        keys = ", ".join(f"{name}.key" for name in found.others)
        yield f"holds {keys}, which do not belong on {host}; `./zenpark hosts install FILE` removes them"
