"""The console entry: refuses to start when another package hides one of ours, for our top-level names are common words.

Only the standard library, and nothing of ours, is imported before the check.
"""

from __future__ import annotations

import gc
import importlib.util
import os
import signal
import sys
from pathlib import Path
from typing import Final

PACKAGES: Final = ("agents", "bridges", "twins", "experiments", "tools")


def intruders(root: Path) -> dict[str, Path | None]:
    """Our packages that would be imported from outside `root`, and the place (None: they are not found)."""
    found: dict[str, Path | None] = {}
    for name in PACKAGES:
        spec = importlib.util.find_spec(name)
        places = list(spec.submodule_search_locations or [spec.origin or ""]) if spec else []
        first = Path(places[0]).resolve() if places else None
        if first != root / name:
            found[name] = first
    return found


def explanation(found: dict[str, Path | None], root: Path) -> str:
    """Foreign packages in the way, their place, and the remedy."""
    from importlib.metadata import packages_distributions  # noqa: PLC0415 (slow, and needed in trouble only)

    owners = packages_distributions()
    lines = ["zenpark: another package is in the way of ours"]
    for name, place in found.items():
        others = sorted(set(owners.get(name, [])) - {"zenpark"})
        owner = f" (of {', '.join(others)})" if others else ""
        lines.append(f"  '{name}' comes from {place or 'nowhere'}{owner}, not from {root / name}")
    lines.append(
        f"Start {root / 'zenpark'}, which has an environment of its own; or uninstall the other, unset PYTHONPATH, "
        "and start from another folder."
    )
    return "\n".join(lines)


def _become_station(words: list[str]) -> None:
    """Become what a run starts on its hosts, small computers often: typer is for people, and takes as long to import.

    Returns if it is not that.
    """
    if words == ["station"]:
        from experiments.real_time.hosts.station import serve  # noqa: PLC0415 (not before the check)

        sys.exit(serve())
    if words[:1] == ["agent"] and "--lifeline" in words:
        from experiments.real_time.hosts.launcher import RUN  # noqa: PLC0415
        from experiments.real_time.processes import zygote  # noqa: PLC0415

        if (run := os.environ.get(RUN)) and (code := zygote.stand_for(run, words[1:])) is not None:
            sys.exit(code)
        from agents.network.shutdown import end  # noqa: PLC0415
        from experiments.real_time.processes.robot import main as robot  # noqa: PLC0415

        end(lambda: robot(words[1:]))


def main() -> None:
    """Check the packages, then hand over to the command line."""
    for name in ("stdout", "stderr"):
        if getattr(sys, name) is None:  # the caller closed it
            setattr(sys, name, os.fdopen(os.open(os.devnull, os.O_WRONLY), "w"))
    try:
        signal.pthread_sigmask(signal.SIG_UNBLOCK, [signal.SIGINT])  # `./zenpark` blocks it until here
        root = Path(__file__).resolve().parent.parent
        if found := intruders(root):
            print(explanation(found, root), file=sys.stderr)
            sys.exit(2)
        for name in ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS"):  # threads of numpy that wait for each other spin
            os.environ.setdefault(name, "1")
        gc.set_threshold(10_000)  # imports and translations make many objects, and little garbage
        _become_station(sys.argv[1:])
        from tools.main import main as command_line  # noqa: PLC0415 (not before the check)

        command_line()
    except KeyboardInterrupt:
        sys.exit(130)
    finally:
        try:
            sys.stdout.flush()
        except OSError:  # its reader, `head` say, has seen enough, or a full disk was reported already
            os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())


if __name__ == "__main__":
    main()
