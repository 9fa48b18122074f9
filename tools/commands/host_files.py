"""Brings each host of an experiment the certificates of its own robots, over ssh, and nobody else's."""

from __future__ import annotations

import io
import subprocess
import tarfile
from collections.abc import Sequence
from pathlib import Path, PurePosixPath
from typing import Final

from agents.network.lab import AUTHORITY
from experiments.definition.experiment import Host
from experiments.real_time.hosts import certificates, ssh
from experiments.real_time.hosts.hosts import HostError


def deliver(
    name: str, host: Host, script: str, words: Sequence[object], cargo: bytes, *, limit_s: float, late: str, failed: str
) -> str:
    """Lets a script unpack something on a host; returns what it said.

    Args:
        name: Of the host.
        host: Has an address.
        script: For the plain shell there, which finds the cargo on its standard input.
        words: Of the script, from $0 on.
        cargo: A compressed tar.
        limit_s: It must be over within this [s].
        late: What to say if it is not.
        failed: What to say before the reason if it cannot be done.

    Raises:
        HostError: If it was not done.
    """
    assert host.address is not None
    try:
        done = subprocess.run(
            ssh.script(host.address, script, list(map(str, words))),
            input=cargo,
            capture_output=True,
            check=False,
            timeout=limit_s,
        )
    except subprocess.TimeoutExpired:
        raise HostError(f"{name}: {late}") from None
    said = done.stderr.decode(errors="replace").strip()
    if done.returncode == ssh.BROKEN:
        raise HostError(f"{name}: {ssh.explained(host.address, host.zenpark, said)}")
    if done.returncode != 0:
        raise HostError(f"{name}: {failed}: {said or 'it said nothing'}")
    return done.stdout.decode(errors="replace")


def packed(root: Path, names: Sequence[str], mode: int | None = None) -> bytes:
    """What stands at a place, as a compressed tar that names nobody here; nothing that was made there by running it.

    Args:
        root: The place.
        names: Of files and folders there.
        mode: Of all files; None: as they have it.
    """
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


SEND_S: Final = 60.0

# $0 is the folder, the rest is what it is to hold; a lab's own folder or one of something else is not ours to change
PUT: Final = """set -eu
umask 077
folder=$0
if [ -e "$folder" ]; then
    for each in $(ls -A "$folder"); do
        case $each in
            ca.key) echo "$folder is the lab's own folder: say in the file where certificates may go, such as \\
lab = \\"zenpark-lab\\"" >&2; exit 3;;
            *.pem|*.key|.incoming) ;;
            *) echo "$folder holds something else ($each): say in the file where certificates may go, such as \\
lab = \\"zenpark-lab\\"" >&2; exit 3;;
        esac
    done
fi
mkdir -p "$folder"
chmod 700 "$folder"
rm -rf "$folder/.incoming"
mkdir "$folder/.incoming"
tar -xzf - -C "$folder/.incoming"
cd "$folder"
for each in *.pem *.key; do
    if [ -e "$each" ] && [ ! -e ".incoming/$each" ]; then
        rm -f "$each"
        echo "$each"
    fi
done
for each in "$@"; do
    mv ".incoming/$each" "$each"
done
rmdir .incoming
"""


def send(name: str, host: Host, folder: Path, robots: Sequence[str]) -> str:
    """Puts the certificates of some robots on a host, in place of what its folder held; returns what was done.

    Args:
        name: Of the host.
        host: Has an address.
        folder: Of the lab, here.
        robots: Whose; nobody else's stay there.

    Raises:
        HostError: If some cannot be sent, or there is no place for them.
        LabError: If the register of the lab cannot be read.
    """
    if trouble := list(certificates.ended(folder, robots)):
        raise HostError("\n".join(f"{name}: {each}" for each in trouble))
    place = PurePosixPath(host.lab.removeprefix("~/"))
    if place in (PurePosixPath(), PurePosixPath("/")) or ".." in place.parts:
        raise HostError(f"{name}: '{host.lab}' names no folder of its own; write lab = \"zenpark-lab\"")
    # the key before its certificate: who reads them in between finds that they do not fit, and tries again
    files = [f"{AUTHORITY}.pem", *(f"{robot}.{end}" for robot in robots for end in ("key", "pem"))]
    said = deliver(
        name,
        host,
        PUT,
        [place, *files],
        packed(folder, files, mode=0o600),
        limit_s=SEND_S,
        late=f"has not taken its certificates in {SEND_S:g} s; is it overloaded?",
        failed="certificates not put there",
    )
    removed = said.split()
    more = f"; removed {', '.join(removed)}" if removed else ""
    return f"certificates of {', '.join(robots)} put into {place}{more}"
