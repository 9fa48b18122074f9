"""`zenpark router`: `agents.runtime.router`, which the launcher starts, with the rights of an experiment in a lab."""

from __future__ import annotations

import json
import sys
from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any

from agents.network.access_control import Rights
from agents.network.endpoints import DEFAULT_ENDPOINT, from_here
from agents.network.lab import LabError, secured
from agents.network.zenoh_config import settings
from agents.runtime.router import serve
from agents.runtime.run_registry import mine, registered


def command(
    file: str | None,
    *,
    listen: Sequence[str],
    link: Sequence[str] = (),
    lifeline: bool = False,
    lab: str | None = None,
    bodies: str | None = None,
    print_config: bool = False,
) -> int:
    """Runs a router until it is told to end; returns the exit code.

    Args:
        file: The experiment, in a lab: who may say and hear what follows from it.
        listen: Endpoints.
        link: Other routers, with which it is linked.
        lifeline: Whether standard input is a lifeline.
        lab: Folder of certificates, instead of that of the file.
        bodies: What every robot is put into, as in `zenpark run --bodies`.
        print_config: Prints the configuration with which a zenohd does the same instead.

    Raises:
        DocumentError: If the file is wrong.
        EndpointError: If it cannot listen there.
        LabError: If a lab is named and no experiment.
    """
    if file is None and lab is not None:
        raise LabError(f"name the experiment too, from which the rights follow: zenpark router FILE --lab {lab}")
    rights, folder = (None, None) if file is None else _rights(file, lab, bodies)
    if folder is None:
        endpoints, linked, rights = list(listen) or [DEFAULT_ENDPOINT], list(link), None
    else:
        endpoints, linked = secured(listen, folder), secured(link, folder) if link else []
    if print_config:
        print(json.dumps(of_zenohd(endpoints, linked, rights), indent=1))
        return 0
    with registered(mine("router", "a router by hand", _places(endpoints))) as why:
        if why:
            print(f"zenpark: {why}", file=sys.stderr)
        return serve(endpoints, link=linked, lifeline=lifeline, rights=rights)


def _places(endpoints: Sequence[str]) -> list[str]:
    """Where this machine finds a router; not at a port that the system chooses, nor at what `serve` will refuse."""
    places = []
    for endpoint in endpoints:
        with suppress(ValueError):
            places.append(from_here(endpoint))
    return places


def of_zenohd(endpoints: Sequence[str], link: Sequence[str] = (), rights: Rights | None = None) -> dict[str, Any]:
    """The configuration with which a zenohd is the router that `serve` would be, as its file has it.

    Raises:
        EndpointError: As `serve`.
    """
    made: dict[str, Any] = {}
    for path, value in settings("router", listen=endpoints, connect=link, name="router", rights=rights).items():
        *above, last = path.split("/")
        inner = made
        for part in above:
            inner = inner.setdefault(part, {})
        inner[last] = value
    return made


def _rights(file: str, lab: str | None, bodies: str | None) -> tuple[Rights, Path | None]:
    from experiments.definition import access_rights  # noqa: PLC0415 - a router without a lab is light
    from experiments.definition import endpoints as reach  # noqa: PLC0415
    from experiments.definition.bodies import choose_bodies  # noqa: PLC0415
    from experiments.file import document  # noqa: PLC0415 - a router without a lab is light

    read = document.read(file)
    cases = [choose_bodies(case, bodies) for case in read.cases().values()]
    return access_rights.rights(cases), reach.folder(read.experiment, read.path, lab)
