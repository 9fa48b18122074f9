"""Small experiments for directed scripts: they start within seconds, and nothing in them depends on chance."""

from __future__ import annotations

from collections.abc import Mapping

from tests.simulated.faults import Fault

TICK_S = 0.01  # period of robots at 100 Hz
AT_S = 1.005  # instant between two ticks

PAIR = """
title = "two on wheels"
duration_s = 3.0
trigger = { kind = "periodic", period_s = 0.1 }
[robots]
A = { kind = "khepera4", start = [-0.5, 0.0] }
B = { kind = "khepera4", start = [0.5, 0.0] }
[formation]
links = { "A - B" = 0.9 }
"""

TRIO = """
title = "three on wheels"
duration_s = 3.0
trigger = { kind = "periodic", period_s = 0.1 }
[robots]
A = { kind = "khepera4", start = [-0.5, -0.3] }
B = { kind = "khepera4", start = [0.5, -0.3] }
C = { kind = "khepera4", start = [0.0, 0.5] }
[formation]
links = { "A - B" = 0.9, "B - C" = 0.9, "C - A" = 0.9 }
"""

DRONE = """
title = "one on wheels, one in the air"
duration_s = 3.0
trigger = { kind = "periodic", period_s = 0.1 }
[robots]
A = { kind = "khepera4", start = [-0.5, 0.0] }
C = { kind = "crazyflie", start = [0.3, 0.0], hover = 0.8 }
[formation]
links = { "A - C" = 1.1 }
"""

_HALL = """
title = "robots that do not hear each other"
duration_s = {}
arena.size = [8.0, 8.0, 2.5]
trigger = {{ kind = "periodic", period_s = 0.5 }}
formation.links = {{}}
[robots]
{}
"""


def hall(kinds: Mapping[str, str], duration_s: float, end: str = "") -> str:
    """Robots of these kinds, by name, each alone; `end` of the file. The first one stands at a wall."""
    robots = []
    for row, (name, kind) in enumerate(kinds.items()):
        start = [1.5 * (row % 5) - 3.0, 1.5 * (row // 5) - 3.0] if row else [3.8, 3.8]
        hover = ", hover = 0.5" if kind == "crazyflie" else ""
        robots.append(f'{name} = {{ kind = "{kind}", start = {start}{hover} }}')
    return _HALL.format(duration_s, "\n".join(robots)) + end


def body(reading: str | tuple[str, float], lasts: float = 9.0) -> Fault:
    """A wrong reading of the body of a robot that is named later."""
    return Fault(AT_S, "body", "", reading, lasts)
