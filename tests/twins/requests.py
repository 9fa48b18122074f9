"""Requests for bodies of simulated robots."""

from collections.abc import Mapping, Sequence

from agents.body.interface import BodyRequest, Disturbance
from agents.body.kinds import Kind
from agents.network.keys import Keys
from agents.vectors import Vector


def request(
    kinds: Sequence[Kind],
    start: Sequence[Sequence[float]] | None = None,
    *,
    yaw: Sequence[float] | None = None,
    disturbance: Mapping[str, Disturbance] | Disturbance | None = None,
    seeds: Sequence[int] | None = None,
    names: Sequence[str] | None = None,
    hz: float = 100.0,
) -> BodyRequest:
    """Robots R0, R1, ... at `start` (x, y[, z] of each) [m], with the seeds 0, 1, ..., disturbed all, or by name."""
    n = len(kinds)
    named = tuple(names or (f"R{k}" for k in range(n)))
    places: list[Vector] = [(x, y, z[0] if z else 0.0) for x, y, *z in start or [(0.0, 0.0)] * n]
    own = disturbance if isinstance(disturbance, Mapping) else dict.fromkeys(named, disturbance or Disturbance())
    return BodyRequest(
        names=named,
        kinds=tuple(kinds),
        addresses=("twin",) * n,
        start=tuple(places),
        yaw=tuple(yaw or (0.0,) * n),
        rate_hz=hz,
        seeds=tuple(seeds or range(n)),
        disturbance=tuple(own.get(name, Disturbance()) for name in named),
        external=(False,) * n,
        device=({},) * n,
        endpoints=(),
        keys=Keys("park"),
    )
