"""The ready-made experiment of `zenpark soak`: groups of robots behind leaders that drive in circles for ever.

Motion never ends, so events keep flowing; groups hear nobody outside, so the load grows with the robots and no faster.
"""

from __future__ import annotations

from typing import Final

SPACING: Final = 2.0  # [m] between the leaders of neighbouring groups
MEMBERS: Final = (  # kind, offset from the leader [m], links to members before it by place
    ("turtlebot3", (0.0, 0.0), ()),
    ("khepera4", (-0.5, 0.0), (0,)),
    ("crazyflie", (0.5, 0.0), (0,)),
    ("crazyflie", (0.0, 0.5), (0, 2)),
    ("khepera4", (0.0, -0.5), (0, 1)),
)
PREFIX: Final = {"crazyflie": "CF", "khepera4": "KH", "turtlebot3": "TB"}
CIRCLE_M: Final = 0.3
TURN_S: Final = 30.0
HEAD: Final = """\
title = "Endurance: {count} robots in groups behind leaders that never rest"
duration_s = {duration:g}
seed = 1
trigger = {{ kind = "send-on-delta", threshold = 0.01 }}   # m

[arena]
size = [{width:g}, {width:g}, 2.0]

[rates]
state_hz = 10                        # telemetry for hours: five times less than usual

[disturbance.all]
position_sigma = 0.0003              # m

[safety]
battery_low = 0                      # it lasts longer than a drone's battery

[formation]
law = "displacement"

"""


def text(count: int, duration_s: float) -> str:
    """The experiment file for so many robots.

    Args:
        count: At least 2.
        duration_s: [s].
    """
    groups = -(-count // len(MEMBERS))
    columns = next(side for side in range(1, groups + 1) if side * side >= groups)
    robots: list[str] = []
    links: list[str] = []
    legs: list[str] = []
    for group in range(groups):
        x, y = ((place - (columns - 1) / 2) * SPACING for place in (group % columns, group // columns))
        names: list[str] = []
        for kind, (dx, dy), heard in MEMBERS[: count - group * len(MEMBERS)]:
            name = f"{PREFIX[kind]}{len(robots) + 1:02}"
            hover = ", hover = 0.8" if kind == "crazyflie" else ""
            yaw = "" if names else ", 0.0"
            robots.append(f'{name} = {{ kind = "{kind}", start = [{x + dx:g}, {y + dy:g}{yaw}]{hover} }}')
            for other in heard:
                ox, oy = MEMBERS[other][1]
                arrow = ">" if other == 0 else "-"
                links.append(f'"{names[other]} {arrow} {name}" = {{ offset = [{dx - ox:g}, {dy - oy:g}] }}')
            if not names:
                plan = f'{{ kind = "circle", radius = {CIRCLE_M:g}, period_s = {TURN_S:g} }}'
                legs.append(f'[[timeline]]\nat_s = 0.0\nrobot = "{name}"\nplan = {plan}\n')
            names.append(name)
    head = HEAD.format(count=count, duration=duration_s, width=SPACING * columns + 1.0)
    return (
        head
        + "[formation.links]\n"
        + "\n".join(links)
        + "\n\n[robots]\n"
        + "\n".join(robots)
        + "\n\n"
        + "\n".join(legs)
    )
