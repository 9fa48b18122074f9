"""Consent of the user before an experiment that others wrote touches machines, devices or networks."""

from __future__ import annotations

import os
import sys
from collections.abc import Iterable, Mapping
from pathlib import Path

from agents.network.endpoints import Endpoint
from experiments.definition.plan import Plan
from experiments.file.problems import refusal
from experiments.real_time.conductor.conduct import hardware
from tools.terminal import say


def belongs_to_another(file: Path) -> bool:
    """Whether a file is of another user than the one who asks, the system's, and the owner of this zenpark."""
    own = {os.geteuid(), 0, Path(__file__).stat().st_uid}
    if os.environ.get("SUDO_UID", "").isdecimal():
        own.add(int(os.environ["SUDO_UID"]))
    return file.exists() and file.stat().st_uid not in own


def touched(cases: Iterable[Plan]) -> list[str]:
    """Machines, devices and networks beyond this machine's own processes that a run in real time touches, in words."""
    every = list(cases)
    found = [f"device of {name}: {address}" for name, address in hardware(every).items() if address]
    for case in (plan.experiment for plan in every):
        for name, host in case.hosts.items():
            if host.address is not None:
                robots = ", ".join(host.robots)
                found.append(
                    f"machine {name}: `ssh {host.address} {host.zenpark}`, for {robots}; it reaches the router"
                )
        network = case.network
        for what, endpoints in (
            ("joins the network at", network.connect), ("listens at", network.listen),
            ("robots listen at", network.addresses.values()),
        ):  # fmt: skip
            found += [f"{what} {each}" for each in endpoints or () if not Endpoint.parse(each).is_loopback]
        if case.capture is not None and not case.capture.simulated:
            found.append(f"motion capture: {case.capture.source}")
    return list(dict.fromkeys(found))


def require(file: str, cases: Mapping[str, Plan], *, given: bool) -> None:
    """Let the user agree to what a run in real time touches, which is named; nothing is asked where that is nothing.

    Raises DocumentError if the user does not agree, or cannot be asked; `given`: the command line agrees already.
    """
    lines = touched(cases.values())
    if not lines:
        return
    say(f"zenpark: {file} is not of your making, and a run of it touches:", to=sys.stderr)
    say(*(f"  {line}" for line in lines), to=sys.stderr)
    if given:
        return
    if not (sys.stdin.isatty() and sys.stderr.isatty()):
        raise refusal(
            file, "it touches machines or devices, and there is no terminal for a question", "agree to that with --yes"
        )
    print("Run it? [y/N] ", end="", file=sys.stderr, flush=True)
    if sys.stdin.readline().strip().lower() not in ("y", "yes"):
        raise refusal(file, "not run", "--here keeps robots on this machine, --bodies twin off their devices")
