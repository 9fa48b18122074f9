"""Identities of a laboratory: certificates, their files, and endpoints that ask for them.

A lab is a folder. `lab.json` is the register of identities; `ca.pem` the authority that all trust; `CF01.pem` and
`CF01.key` are an identity. A robot's computer needs `ca.pem` and its own two files, a router the register as well.
`ca.key`, which makes new identities, belongs on the computer of the operator of the lab and nowhere else.

Within the project an endpoint carries its lab behind it, `tls/127.0.0.1:7447#lab=/home/ana/lab`: the address of a
router tells how to be let in.
"""

from __future__ import annotations

import hashlib
import secrets
import stat
from collections.abc import Sequence
from pathlib import Path
from typing import Final, Literal, NamedTuple, get_args

import msgspec

from agents.errors import ExplainedError

Role = Literal[
    "robot", "operator", "observer", "router", "recorder", "world", "positioning", "twin", "centre", "ros2"
]  # fmt: skip
ROLES: Final[tuple[Role, ...]] = get_args(Role)

REGISTER: Final = "lab.json"
AUTHORITY: Final = "ca"
MARK: Final = "#lab="
UNUSABLE: Final = ";?"  # letters that may not stand in the path of a lab: they separate the parts of an endpoint
MARK_BYTES: Final = 8  # first bytes of an id of 16
SECURE: Final = ("tls", "quic")
DEFAULT_SECURE: Final = "tls/127.0.0.1:7447"


class LabError(ExplainedError, ValueError):
    """A lab, a certificate or an endpoint of a lab that cannot be used, with the remedy."""


class Identity(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Holder of a certificate."""

    role: Role  # decides its rights
    # of its present certificate: its name, or `CF01.2` for the second one. A certificate with an earlier common name is
    # still the lab's, and gives no right.
    common_name: str
    serial: str  # number of that certificate, in hexadecimal
    until: str  # end of its validity, UTC, ISO 8601
    hosts: list[str] = []  # names and addresses at which it may listen


class Register(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Identities of a lab, by name."""

    identities: dict[str, Identity]


class Files(NamedTuple):
    """The files of an identity."""

    authority: Path
    certificate: Path
    key: Path


def register(folder: Path) -> Register:
    """The register of a lab; raises LabError if there is none, or it cannot be read."""
    file = folder / REGISTER
    try:
        return msgspec.json.decode(file.read_bytes(), type=Register)
    except FileNotFoundError:
        raise LabError(
            f"{folder} is no lab, {REGISTER} is missing: `./zenpark lab init {folder} FILE` makes one"
        ) from None
    except OSError as error:
        raise LabError(f"{file}: cannot be read: {error.strerror}") from None
    except msgspec.MsgspecError as error:
        raise LabError(f"{file}: {error}; put it back as `./zenpark lab` wrote it") from None


def files(folder: Path, name: str) -> Files:
    """The files of an identity, checked: all exist, and only the user can read the key; raises LabError if not."""
    found = Files(folder / f"{AUTHORITY}.pem", folder / f"{name}.pem", folder / f"{name}.key")
    for file in found:
        try:
            mode = file.stat().st_mode
            with file.open("rb"):
                pass
        except FileNotFoundError:
            raise LabError(
                f"{file} is missing: copy it from the lab's own folder, or make it there with "
                f"`./zenpark lab issue {folder} {name}`, if it had one before with "
                f"`./zenpark lab renew {folder} {name}`"
            ) from None
        except OSError as error:
            raise LabError(f"{file}: cannot be read: {error.strerror}") from None
        if file == found.key and stat.S_IMODE(mode) & 0o077:
            raise LabError(f"{file}: others can read this key: `chmod 600 {file}`, or revoke it if they have read it")
    return found


def require(folder: Path, names: Sequence[str]) -> None:
    """Checks identities before anything is started; raises LabError for the first wrong one, or all missing ones."""
    missing = [name for name in names if not (folder / f"{name}.pem").exists()]
    if len(missing) > 1:
        remedy = f"`./zenpark lab issue {folder} {' '.join(missing)}`"
        raise LabError(f"{folder} has no certificates of {', '.join(missing)}: {remedy}")
    for name in names:
        files(folder, name)


def secured(endpoints: Sequence[str], lab: str | Path | None) -> list[str]:
    """The endpoints, each with the lab that it needs; as they are without a lab.

    Without endpoints the usual one on this machine is meant. Those that name a lab already keep it. Raises LabError if
    one is neither tls/ nor quic/, so that certificates would not be asked for, or if Zenoh does not accept the path.
    """
    if lab is None:
        return list(endpoints)
    folder = Path(lab).absolute()
    check_path(folder)
    made = []
    for endpoint in endpoints or [DEFAULT_SECURE]:
        plain = endpoint.partition(MARK)[0]
        protocol, _, address = plain.partition("/")
        if protocol not in SECURE:
            raise LabError(f"{plain} asks for no certificate, which a lab needs: write tls/{address} or quic/{address}")
        made.append(endpoint if MARK in endpoint else f"{endpoint}{MARK}{folder}")
    return made


def check_path(folder: Path) -> None:
    """Raises LabError if the path of a lab cannot stand in an endpoint of Zenoh."""
    found = [character for character in UNUSABLE if character in str(folder.absolute())]
    if found or not str(folder).isprintable():
        which = " and ".join(f"'{character}'" for character in found) or "what cannot be printed"
        raise LabError(f"{str(folder)!r}: Zenoh accepts no path of a lab with {which}: rename or move the folder")


def bare(endpoints: Sequence[str]) -> list[str]:
    """The endpoints as Zenoh takes them."""
    return [endpoint.partition(MARK)[0] for endpoint in endpoints]


def options(endpoint: str) -> str:
    """Command-line options that reach an endpoint."""
    plain, mark, folder = endpoint.partition(MARK)
    return f"--connect {plain}" + (f" --lab {folder}" if mark else "")


def lab_of(endpoints: Sequence[str]) -> Path | None:
    """The lab of some endpoints; raises LabError if only some are of one, or of another: a session has one identity."""
    folders = {endpoint.partition(MARK)[2] for endpoint in endpoints}
    if len(folders) > 1:
        raise LabError(f"{', '.join(endpoints)}: a session belongs to one lab or to none; name routers of one only")
    folder = folders.pop() if folders else ""
    if not folder:
        return None
    secured(endpoints, folder)
    return Path(folder)


def session_id(name: str) -> str:
    """A Zenoh id, as text, for a session of an identity: random, and with the mark of its name at the end.

    A router accepts one session per id, the first; by the mark it recognises an id that was taken from another
    identity.
    """
    first = secrets.choice("123456789abcdef")  # an id has no leading zero
    return first + secrets.token_hex(16)[: 31 - len(_mark(name))] + _mark(name)


def _mark(name: str) -> str:
    return hashlib.blake2s(name.encode(), digest_size=MARK_BYTES).hexdigest()


def robbed(known: Register, zid: str, common_name: str | None) -> str | None:
    """Identity of the mark in a session's id, if it differs from that of the certificate; else None."""
    for name, identity in known.identities.items():
        if zid.endswith(_mark(name)):
            return None if common_name == identity.common_name else name
    return None


def settings(folder: Path, name: str, *, listens: bool) -> dict[str, object]:
    """Zenoh settings with which an identity shows its certificate and asks for that of the other end."""
    authority, certificate, key = (str(file) for file in files(folder, name))
    tls: dict[str, object] = {
        "root_ca_certificate": authority,
        "connect_certificate": certificate,
        "connect_private_key": key,
        "enable_mtls": True,
        "verify_name_on_connect": True,
        "close_link_on_expiration": True,
    }
    if listens:
        tls |= {"listen_certificate": certificate, "listen_private_key": key}
    return {"transport/link/tls": tls, "id": session_id(name)}
