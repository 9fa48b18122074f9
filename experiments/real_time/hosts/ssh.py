"""The system's `ssh`: how a command on another machine is spelled, and what it means when that fails."""

from __future__ import annotations

import re
import shlex
from collections.abc import Sequence
from typing import Final

from agents.network.endpoints import UNIX, Endpoint

CONNECT_S: Final = 10
BROKEN: Final = 255  # exit code of ssh when it is ssh itself that failed

# BatchMode: no user could answer a question. Four missed replies end a connection, as silence ends a robot's lifeline.
OPTIONS: Final = {
    "BatchMode": "yes",
    "ConnectTimeout": str(CONNECT_S),
    "ServerAliveInterval": "1",
    "ServerAliveCountMax": "4",
    "ExitOnForwardFailure": "yes",
    "ControlPath": "none",  # a connection that is shared takes all of its robots along when it ends
    "IPQoS": "af21",  # what has no terminal is marked as bulk otherwise, which a radio sends last
    "LogLevel": "INFO",  # says which port was allocated
}
_ALLOCATED: Final = re.compile(r"^Allocated port (\d+) for remote forward to (.*?)\s*$", re.MULTILINE)
_TROUBLE: Final = (
    (r"remote host identification has changed", "its host key is not the one that is known here",
     "find out why before anything else; then `ssh-keygen -R` forgets the old one"),
    (r"host key is known|host key verification failed", "its host key is not known here",
     "log in once by hand (ssh {address}) and compare the fingerprint that it shows"),
    (r"permission denied \(", "none of our keys lets us in",
     "ssh-copy-id {address}, or load the key into the agent (ssh-add); no password can be typed here"),
    (r"could not resolve hostname", "no machine of that name is known",
     "mend its address, or give it a HostName in ~/.ssh/config"),
    (r"connection refused|timed out|no route to host|network is unreachable|host is down", "it cannot be reached",
     "is it on, in this network, and does its sshd run? Try ssh {address}"),
    (r"not responding", "the connection to it broke", "is it still on, and in reach of the network?"),
    (r"remote port forwarding failed", "its sshd forwards no ports",
     "allow it there (AllowTcpForwarding yes), or let the router listen where hosts find it: listen in [network]"),
    (r"no such command '(station|agent)'", "the zenpark there is too old for this one",
     "`./zenpark hosts install FILE` puts this one there"),
    (r"permission denied$|cannot execute", "'{zenpark}' may not be started there",
     "chmod +x {zenpark} there, or `./zenpark hosts install FILE`"),
    (r"python3\W*: (no such|not found)|env: .*python3", "there is no Python there",
     "install one, 3.11 or newer (Debian, Ubuntu: apt install python3 python3-pip)"),
    (r"not found|no such file", "there is no zenpark at '{zenpark}'",
     "`./zenpark hosts install FILE` puts it there; or say where it is: zenpark = \"...\""),
)  # fmt: skip
# words of ./zenpark, which may repeat those of pip about a network
_NOT_STARTED: Final = re.compile(r"^zenpark: (cannot prepare .*|zenpark needs .*|\w+ing .* failed:)(?:\n +(.*))?", re.M)


def command(address: str, words: Sequence[str], options: Sequence[str] = ()) -> list[str]:
    """The command line that runs a command on another machine, without a shell that stays in between."""
    settings = [part for name, value in OPTIONS.items() for part in ("-o", f"{name}={value}")]
    return ["ssh", "-T", *settings, *options, "--", address, f"exec {shlex.join(words)}"]


def explained(address: str, zenpark: str, output: str) -> str:
    """Cause and remedy of a failed ssh, by its output."""
    if (found := _NOT_STARTED.search(output)) is not None:
        why = " ".join(filter(None, found.groups()))
        return f"zenpark does not start there: {why}; mend that, then start it there by hand: {zenpark} --version"
    for pattern, cause, remedy in _TROUBLE:
        if re.search(pattern, output, re.IGNORECASE | re.MULTILINE):
            return f"{cause}; {remedy}".format(address=address, zenpark=zenpark)
    last = output.strip().splitlines()[-1:] or ["it said nothing"]
    return f"ssh failed: {last[0]}; try it by hand, which must ask nothing: ssh {address} true"


def forwarded(endpoint: Endpoint) -> str:
    """The argument of `ssh -R` by which another machine reaches an endpoint of this one, at a port that sshd chooses.

    Raises ValueError if ssh carries no such protocol.
    """
    if endpoint.protocol not in ("tcp", "tls", UNIX):
        raise ValueError(
            f"{endpoint} cannot be reached through ssh; use tcp or tls there, or let the router listen where hosts "
            "find it: listen in [network]"
        )
    host = f"[{endpoint.host}]" if ":" in endpoint.host else endpoint.host
    return f"127.0.0.1:0:{host}" + (f":{endpoint.port}" if endpoint.port else "")


def allocated(output: str) -> list[int]:
    """The ports that sshd chose, in the order of the `-R`, by the output of ssh."""
    return [int(port) for port, _ in _ALLOCATED.findall(output)]
