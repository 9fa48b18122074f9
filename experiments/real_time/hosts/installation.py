"""Put this zenpark, the certificates of a lab or the watchdog of a robot on another machine over ssh."""

from __future__ import annotations

import io
import tarfile
from collections.abc import Sequence
from importlib.util import find_spec
from pathlib import Path, PurePosixPath
from typing import Final

from agents.body.kinds import Kind
from agents.network.lab import AUTHORITY
from experiments.definition.experiment import Host
from experiments.real_time.hosts import certificates
from experiments.real_time.hosts.hosts import HostError, run_script
from experiments.recording import version

INSTALL_S: Final = 900.0
SEND_S: Final = 60.0
WATCHDOG_S: Final = 120.0
FILES: Final = ("zenpark", "face", "pyproject.toml", "README.md", "LICENSE")
PUT_ZENPARK: Final = Path(__file__).with_name("put_zenpark.sh").read_text("utf-8")
PUT_CERTIFICATES: Final = Path(__file__).with_name("put_certificates.sh").read_text("utf-8")
WATCHDOG_FOLDER: Final = "zenpark-watchdog"  # name in the home folder on the robot


def put(name: str, host: Host) -> str:
    """Put this zenpark on a host, and make it ready; return what it then says of itself.

    Raises HostError if there is no place for it, or it cannot be made ready there.
    """
    place = PurePosixPath(host.zenpark.removeprefix("~/"))
    if place.name != "zenpark" or place.parent in (PurePosixPath(), PurePosixPath("/")):
        raise HostError(f"{name}: '{host.zenpark}' names no folder of its own; write zenpark = \"zenpark/zenpark\"")
    if not (version.ROOT / "zenpark").is_file():
        raise HostError(f"{name}: this zenpark is no checkout, which is what can be copied; start ./zenpark of one")
    wanted = [*version.PACKAGES, *FILES, *sorted(path.name for path in version.ROOT.glob("requirements*.lock"))]
    names = [each for each in wanted if (version.ROOT / each).exists()]
    script, content = (PUT_ZENPARK, place.parent, *names), packed(version.ROOT, names)
    late = f"not ready after {INSTALL_S / 60:g} minutes; start {place} there by hand"
    output = run_script(name, host, script, content, limit_s=INSTALL_S, late=late, failed="not installed: ")
    return f"{output.strip()} ({version.digest()[: version.DIGEST_CHARACTERS]}) installed"


def packed(root: Path, names: Sequence[str], mode: int | None = None) -> bytes:
    """Files of a folder as a compressed tar without user names and files made by running it; `mode` of all, if any."""
    sink = io.BytesIO()

    def kept(member: tarfile.TarInfo) -> tarfile.TarInfo | None:
        member.uid = member.gid = 0
        member.uname = member.gname = ""
        member.mode = member.mode if mode is None else mode
        return None if "__pycache__" in PurePosixPath(member.name).parts else member

    with tarfile.open(fileobj=sink, mode="w:gz", compresslevel=6) as tar:
        for name in names:
            tar.add(root / name, name, filter=kept)
    return sink.getvalue()


def send(name: str, host: Host, folder: Path, robots: Sequence[str]) -> str:
    """Put the certificates of some robots on a host, in place of all that its folder held; return what was done.

    Raises HostError if some cannot be sent, or there is no place for them; LabError without a register of the lab.
    """
    if trouble := list(certificates.ended(folder, robots)):
        raise HostError("\n".join(f"{name}: {each}" for each in trouble))
    place = PurePosixPath(host.lab.removeprefix("~/"))
    if place in (PurePosixPath(), PurePosixPath("/")) or ".." in place.parts:
        raise HostError(f"{name}: '{host.lab}' names no folder of its own; write lab = \"zenpark-lab\"")
    # the key before its certificate: a process that reads them in between finds that they do not fit, and tries again
    files = [f"{AUTHORITY}.pem", *(f"{robot}.{end}" for robot in robots for end in ("key", "pem"))]
    script, content = (PUT_CERTIFICATES, place, *files), packed(folder, files, mode=0o600)
    late, failed = f"has not taken its certificates in {SEND_S:g} s; is it overloaded?", "certificates not put there: "
    output = run_script(name, host, script, content, limit_s=SEND_S, late=late, failed=failed)
    removed = output.split()
    more = f"; removed {', '.join(removed)}" if removed else ""
    return f"certificates of {', '.join(robots)} put into {place}{more}"


def watchdog(kind: Kind) -> Path:
    """The program that stops robots of a kind without commands; raises HostError if there is none."""
    spec = find_spec(kind.watchdog) if kind.watchdog else None
    if spec is None or spec.origin is None:
        raise HostError(f"the kind {kind.name} has no watchdog for its own computer")
    return Path(spec.origin)


def put_watchdog(kind: Kind, robot: str, *, namespace: str, domain: int, silence_s: float) -> list[str]:
    """Put the watchdog of a robot on it, without zenpark there, and start it; returns what there is to say.

    Args:
        kind: Kind of the robot.
        robot: Address as ssh takes it.
        namespace: Of the robot's ROS nodes, without slashes around it; may be empty.
        domain: ROS_DOMAIN_ID.
        silence_s: Time without a command after which the robot is stopped [s].

    Raises:
        HostError: If the robot cannot be reached, has no ROS 2, or the watchdog does not come up.
    """
    return _watchdog_script(kind, robot, "put_watchdog.sh", namespace, str(domain), f"{silence_s:g}")


def remove_watchdog(kind: Kind, robot: str) -> list[str]:
    """Stop the watchdog and remove it; returns what there is to say."""
    return _watchdog_script(kind, robot, "remove_watchdog.sh")


def _watchdog_script(kind: Kind, robot: str, script: str, *arguments: str) -> list[str]:
    program = watchdog(kind)
    text = program.with_name(script).read_text("utf-8")
    late = f"did not answer within {WATCHDOG_S:g} s; try it by hand: ssh {robot}"
    words, given = (text, WATCHDOG_FOLDER, *arguments), program.read_bytes()
    return run_script(robot, Host(address=robot), words, given, limit_s=WATCHDOG_S, late=late).splitlines()
