"""Brings files to a host over ssh: packed here, unpacked there by a script that knows what it may replace."""

from __future__ import annotations

import io
import subprocess
import tarfile
from collections.abc import Sequence
from pathlib import Path, PurePosixPath

from experiments import ssh
from experiments.experiment import Host
from experiments.hosts import HostError


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
