"""Processes that serve a whole run, and are started again when they die: router, world, centre, positioning."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Final

from agents import topology
from experiments import standins
from experiments.assign import guided
from experiments.experiment import Experiment
from experiments.launcher import ROUTER, Launcher, Process, is_router

LINGER_S: Final = 15.0  # the router outlives a killed conductor, so that the landing is recorded
STARTS: Final = 4  # who dies more often is not helped by starting it again


@dataclass
class _Servant:
    """What to start, and what becomes of the robots meanwhile, or when it is given up."""

    start: Callable[[], object]
    meanwhile: str = ": robots hold until then"
    given_up: str = ""
    starts: int = 1


class Servants:
    """Those of one case."""

    def __init__(
        self,
        experiment: Experiment,
        case: str,
        *,
        file: Path,
        endpoints: Sequence[str],
        routers: Sequence[str],
        rights: Path | None,
        launcher: Launcher,
    ) -> None:
        """The router and the world are started by others, for the first time; the centre by `start_centre`.

        Args:
            experiment: The case.
            case: Its name.
            file: The same as a file.
            endpoints: Routers as this machine reaches them.
            routers: Where routers of our own listen, which other machines must find again.
            rights: Who may do what, in a lab; None without one.
            launcher: Starts them.
        """
        connect = [part for endpoint in endpoints for part in ("--connect", endpoint)]
        self._centre = f"{case}-centre" if guided(experiment) else None
        several = experiment.network.routers > 1
        self._known = {
            each.name: _Servant(
                partial(each.start, launcher, rights),
                ": all go on at another meanwhile" if several else "",
                ": no other takes its place" if several else ": the robots hold, and land at the end",
            )
            for each in divided(routers, experiment.network.routers)
        } | {
            standins.world_name(case): _Servant(
                lambda: standins.start_world(experiment, file, prefix=case, launcher=launcher, connect=connect)
            ),
        }
        if self._centre is not None:
            name = self._centre
            self._known[name] = _Servant(
                lambda: launcher.start(name, "experiments.centre", str(file), *connect, "--lifeline"),
                given_up=": the robots that it guides hold, and land at the end",
            )

    def keep(self, name: str, start: Callable[[], object]) -> None:
        """Starts the process that says where robots are again as well: those who do not know hold, and drones land."""
        hold = ": robots that do not know where they are hold, drones land"
        self._known[name] = _Servant(start, hold, hold)

    def start_centre(self) -> tuple[str, ...]:
        """Starts the centre, if robots are guided by one; the name of its process."""
        if self._centre is None:
            return ()
        self._known[self._centre].start()
        return (self._centre,)

    def again(self, process: Process, case: str) -> tuple[str, str] | None:
        """Starts one again that has died; what kind it is, and what is to be said. None if it is no servant."""
        servant = self._known.get(process.name)
        if servant is None:
            return None
        kind = process.name.removeprefix(f"{case}-")
        more = servant.starts < STARTS
        if more:
            servant.starts += 1
            servant.start()
        what = f"started again{servant.meanwhile}" if more else f"given up{servant.given_up}"
        last = [] if is_router(process.name) else process.tail().strip().splitlines()[-1:]
        return kind, f"the {kind} ended ({process.exit}); {what}" + "".join(f": {line}" for line in last)


@dataclass(frozen=True)
class Router:
    """A router of our own.

    Attributes:
        name: Of its process.
        listen: Where it listens.
        link: The routers before it, which it seeks for as long as it lives, so that any two are linked once.
    """

    name: str
    listen: Sequence[str]
    link: Sequence[str] = ()

    def start(self, launcher: Launcher, rights: Path | None = None) -> None:
        """Starts it; it outlives a killed launcher by as long as robots take to land. In a lab it enforces `rights`."""
        listen = [part for endpoint in self.listen for part in ("--listen", endpoint)]
        link = [part for endpoint in self.link for part in ("--connect", endpoint)]
        enforced = [] if rights is None else ["--rights", str(rights)]
        launcher.start(self.name, "agents.router", *listen, *link, *enforced, "--lifeline", "--linger", str(LINGER_S))


def start_router(launcher: Launcher, endpoints: Sequence[str], rights: Path | None = None) -> None:
    """Starts one router, which listens at all of these."""
    Router(ROUTER, endpoints).start(launcher, rights)


def divided(endpoints: Sequence[str], count: int) -> list[Router]:
    """So many routers, with these endpoints in turn."""
    made: list[Router] = []
    for number in range(count):
        link = [topology.from_here(before.listen[0]) for before in made]
        made.append(Router(f"{ROUTER}{number + 1}" if number else ROUTER, list(endpoints[number::count]), link))
    return made
