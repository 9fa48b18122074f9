"""Endpoints of the routers of an experiment, and the lab of the certificates that they demand."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from agents.network import lab
from agents.network.endpoints import EndpointError

if TYPE_CHECKING:  # numpy comes with it, and an emergency stop waits for nothing that it does not need
    from experiments.definition.plan import Plan


def lab_folder(plan: Plan, file: Path, chosen: str | None = None) -> Path | None:
    """Folder of the lab: that of the command line, or the one that the file names, beside the file."""
    if chosen is not None:
        return Path(chosen).absolute()
    own = plan.experiment.network.lab
    return None if own is None else file.absolute().parent / own


def router_endpoints(plan: Plan, file: Path, connect: Sequence[str], chosen: str | None = None) -> list[str]:
    """Routers of an experiment, each with its lab if there is one; empty if neither file nor command names any.

    Args:
        plan: Its `network.connect` holds if the command line names none.

    Raises:
        LabError: If a router of a lab asks for no certificates.
    """
    endpoints = read_endpoints(connect) or plan.experiment.network.connect or []
    return lab.secured(endpoints, lab_folder(plan, file, chosen))


def read_endpoints(given: Iterable[str]) -> list[str]:
    """Endpoints, each as it is or, behind an @, line by line from a file.

    Raises EndpointError if a file cannot be read.
    """
    found: list[str] = []
    for each in given:
        if not each.startswith("@"):
            found.append(each)
            continue
        try:
            found += Path(each[1:]).read_text("utf-8").split("\n")
        except (OSError, UnicodeDecodeError) as error:
            raise EndpointError(
                f"{each[1:]}: cannot be read ({error}); `./zenpark run` writes one, network.txt"
            ) from None
    return [each for each in found if each]
