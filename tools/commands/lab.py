"""`./zenpark lab`: the certificates of a lab."""

from __future__ import annotations

from datetime import UTC, datetime
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Final

from typer import Argument, Option

from tools.options import AsJson, example, group, print_result

if TYPE_CHECKING:
    from agents.network.lab import Register, Role

app: Final = group("Make, renew and revoke the certificates of a lab: robots, people, routers.")

Folder = Annotated[str, Argument(metavar="LAB", help="Folder of the lab.")]
Names = Annotated[list[str], Argument(metavar="NAME...", help="Identities.")]
Days = Annotated[float, Option(min=0.01, help="Validity of a certificate [days].")]
Hosts = Annotated[list[str] | None, Option("--host", metavar="HOST", help="Host of its endpoint; may be repeated.")]
SOON_DAYS: Final = 14.0


@app.command(epilog=example("lab init lab robotic-park --host 192.168.0.10"))
def init(
    folder: Folder,
    given: Annotated[
        list[str] | None,
        Argument(metavar="[FILE|ROBOT...]", help="Experiments, for all their robots; or names of robots."),
    ] = None,
    *,
    host: Hosts = None,
    days: Days = 90.0,
    as_json: AsJson = False,
) -> None:
    """Found a lab: its authority, a certificate per robot, and those of router, operator, observer and helpers."""
    from agents.network.lab import LabError
    from experiments.real_time.hosts.authority import SERVICES, create

    place = Path(folder)
    identities: dict[str, Role] = {role: role for role in SERVICES}
    robots, listening = _members(given or [])
    if clash := sorted(robots.keys() & identities.keys()):
        raise LabError(f"{', '.join(clash)}: every lab has an identity of that name; rename the robot")
    identities |= dict.fromkeys(robots, "robot")
    known = create(place, identities, hosts=host or [], listening=listening, days=days)
    advice = (
        f"{place}/ca.key makes new identities: keep it here. A robot's computer needs ca.pem and its own .pem and .key,"
        f" a router's ca.pem, lab.json, router.*\nNow: ./zenpark run FILE --lab {place}, or [network] lab in the file"
    )
    _print(place, known, [], advice, as_json=as_json)


@app.command(epilog=example("lab issue lab ana --role operator"))
def issue(
    folder: Folder,
    names: Names,
    *,
    role: Annotated[str, Option(help="Role: robot, operator, observer, router, ... [by the name]")] = "",
    host: Hosts = None,
    days: Days = 90.0,
    as_json: AsJson = False,
) -> None:
    """Make certificates for more robots, people or routers."""
    from agents.errors import did_you_mean
    from agents.network.lab import ROLES, LabError
    from experiments.real_time.hosts.authority import issue as made

    if role and role not in ROLES:
        raise LabError(f"no role '{role}' in a lab; {did_you_mean(role, ROLES)}")
    roles: dict[str, Role] = {each: each for each in ROLES}
    identities = {name: roles.get(role or name, "robot") for name in names}
    _print(Path(folder), made(Path(folder), identities, hosts=host or [], days=days), names, as_json=as_json)


@app.command(epilog=example("lab renew lab", "lab renew lab router --host 192.168.0.10"))
def renew(
    folder: Folder,
    names: Annotated[list[str] | None, Argument(metavar="[NAME...]", help="Names; all if none is given.")] = None,
    *,
    host: Hosts = None,
    days: Days = 90.0,
    authority: Annotated[bool, Option("--authority", help="A new authority too, which refuses earlier files.")] = False,
    as_json: AsJson = False,
) -> None:
    """Make new certificates for the same names; those before are valid until they end."""
    from experiments.real_time.hosts.authority import renew as made

    known = made(Path(folder), names or [], hosts=host or [], days=days, authority=authority)
    _print(Path(folder), known, names or [], as_json=as_json)


@app.command(epilog=example("lab revoke lab KH01"))
def revoke(folder: Folder, names: Names, days: Days = 90.0, as_json: AsJson = False) -> None:
    """Take all rights from certificates that are lost or stolen, and make new ones."""
    from experiments.real_time.hosts.authority import revoke as made

    advice = (
        "The old keys have no rights at a `./zenpark router` that reads this lab.json: one that runs notices it in a "
        "second; copy the file to routers elsewhere. Poses of their owners are not received any more: give them new "
        "files. A zenohd notices nothing, and the old keys go on working: print its file again (./zenpark router FILE "
        "--lab LAB --print-config) and restart it"
    )
    _print(Path(folder), made(Path(folder), names, days=days), names, advice, as_json=as_json)


@app.command(epilog=example("lab show lab"))
def show(folder: Folder, as_json: AsJson = False) -> int:
    """Show the members of a lab and the ends of their certificates; exit code 1 if a certificate has ended."""
    from agents.network.lab import register

    known = register(Path(folder))
    _print(Path(folder), known, [], as_json=as_json)
    now = datetime.now(UTC)
    return int(any(datetime.fromisoformat(each.until) < now for each in known.identities.values()))


def _members(given: list[str]) -> tuple[dict[str, None], dict[str, list[str]]]:
    """Robots of experiments and those that are named themselves, in order; addresses at which members listen."""
    from difflib import get_close_matches

    from agents.network.lab import LabError
    from experiments.catalogue import index
    from experiments.definition import mesh
    from experiments.file import document

    robots: dict[str, None] = {}
    listening: dict[str, list[str]] = {}
    names = index.names()
    for each in given:
        if each in names or Path(each).suffix or Path(each).exists():
            for case in document.read(each).cases().values():
                robots |= dict.fromkeys(case.names)
                listening |= mesh.listening_hosts(case)
        elif near := get_close_matches(each, names, n=1, cutoff=0.8):
            raise LabError(f"{each} is neither a file nor in the catalogue; did you mean '{near[0]}'?")
        else:
            robots[each] = None
    return robots, listening


def _print(folder: Path, known: Register, names: list[str], advice: str = "", *, as_json: bool) -> None:
    """Print these members of a lab, all if none is named, and advice for people; as JSON a register of them alone."""
    from msgspec.structs import replace

    shown = {name: known.identities[name] for name in names or known.identities}
    now, width = datetime.now(UTC), max(map(len, shown), default=0)
    lines = []
    for name, each in shown.items():
        left = (datetime.fromisoformat(each.until) - now).total_seconds() / 86400.0
        state = "ENDED" if left < 0 else f"{left:.0f} days left" + ("  renew it" if left < SOON_DAYS else "")
        as_name = "" if each.common_name == name else f"  as {each.common_name}"
        hosts = f"  listens at {', '.join(each.hosts)}" if each.hosts else ""
        lines.append(f"{name:<{width}}  {each.role:<11}  until {each.until[:16]}  {state}{as_name}{hosts}")
    lines += [f"lab: {folder}", *([advice] if advice else [])]
    print_result(replace(known, identities=shown), *lines, as_json=as_json)
