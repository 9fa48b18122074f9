"""Brings each host of an experiment the certificates of its own robots, over ssh, and nobody else's."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path, PurePosixPath
from typing import Final

from agents.lab import AUTHORITY
from experiments import certificates
from experiments.experiment import Host
from experiments.hosts import HostError
from tools.freight import deliver, packed

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
