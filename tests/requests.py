"""Requests for bodies and devices."""

from collections.abc import Mapping, Sequence
from typing import Any

from agents.body.interface import BodyRequest, Disturbance
from agents.body.kinds import KINDS, Kind
from agents.network.keys import Keys


def request(
    kinds: str | Kind | Sequence[str | Kind],
    addresses: str | Sequence[str] = "twin",
    *,
    start: Sequence[Sequence[float]] | None = None,
    yaw: float | Sequence[float] = 0.0,
    disturbance: Mapping[str, Disturbance] | Disturbance | None = None,
    device: Mapping[str, Any] | None = None,
    external: bool = False,
    names: Sequence[str] | None = None,
    seeds: Sequence[int] | None = None,
    rate_hz: float = 100.0,
    **rest: Any,
) -> BodyRequest:
    """Robots R0, R1, ... with the seeds 1, 2, ..., 1 m apart on the y axis; one value stands for that of all rows.

    Args:
        start: x, y and, if not 0, z of each [m].
        yaw: [rad].
        disturbance: Of all, or by name.
        rest: `endpoints`, `keys`, `clock`.
    """
    columns = (kinds, addresses, start, names)
    rows = next((len(column) for column in columns if column is not None and not isinstance(column, str | Kind)), 1)

    def each(value: Any) -> tuple[Any, ...]:
        return (value,) * rows if isinstance(value, str | Kind | float | int) else tuple(value)

    named = tuple(names or (f"R{row}" for row in range(rows)))
    disturbed = disturbance if isinstance(disturbance, Mapping) else dict.fromkeys(named, disturbance or Disturbance())
    places = [(0.0, float(row)) for row in range(rows)] if start is None else start
    return BodyRequest(
        names=named,
        kinds=tuple(KINDS[kind] if isinstance(kind, str) else kind for kind in each(kinds)),
        addresses=each(addresses),
        start=tuple((float(x), float(y), float(z[0]) if z else 0.0) for x, y, *z in places),
        yaw=tuple(map(float, each(yaw))),
        rate_hz=rate_hz,
        seeds=tuple(seeds or range(1, rows + 1)),
        disturbance=tuple(disturbed.get(name, Disturbance()) for name in named),
        external=(external,) * rows,
        device=(device or {},) * rows,
        **{"endpoints": (), "keys": Keys("park"), **rest},
    )
