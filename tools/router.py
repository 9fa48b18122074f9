"""`zenpark router`: as `agents.router`, which the launcher starts, with the rights of an experiment in a lab."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from agents.access import Rights
from agents.lab import LabError, secured
from agents.router import serve
from agents.session import DEFAULT_ENDPOINT


def command(
    file: str | None,
    *,
    listen: Sequence[str],
    link: Sequence[str] = (),
    lifeline: bool = False,
    lab: str | None = None,
    bodies: str | None = None,
) -> int:
    """Runs a router until it is told to end; returns the exit code.

    Args:
        file: The experiment, in a lab: who may say and hear what follows from it.
        listen: Endpoints.
        link: Other routers, with which it is linked.
        lifeline: Whether standard input is a lifeline.
        lab: Folder of certificates, instead of that of the file.
        bodies: What every robot is put into, as in `zenpark run --bodies`.

    Raises:
        DocumentError: If the file is wrong.
        EndpointError: If it cannot listen there.
        LabError: If a lab is named and no experiment.
    """
    if file is None:
        if lab is not None:
            raise LabError(f"name the experiment too, from which the rights follow: zenpark router FILE --lab {lab}")
        return serve(listen or [DEFAULT_ENDPOINT], link=link, lifeline=lifeline)
    rights, folder = _rights(file, lab, bodies)
    if folder is None:
        return serve(listen or [DEFAULT_ENDPOINT], link=link, lifeline=lifeline)
    linked = secured(link, folder) if link else []
    return serve(secured(listen, folder), link=linked, lifeline=lifeline, rights=rights)


def _rights(file: str, lab: str | None, bodies: str | None) -> tuple[Rights, Path | None]:
    from experiments import access, document, reach  # noqa: PLC0415 - a router without a lab is light
    from experiments.standins import choose_bodies  # noqa: PLC0415

    read = document.read(file)
    cases = [choose_bodies(case, bodies) for case in read.cases().values()]
    return access.rights(cases), reach.folder(read.experiment, read.path, lab)
