"""What a world did is said in words."""

import pytest

from agents.network.messages import WorldOrder
from tools.commands.orders import done


@pytest.mark.parametrize(
    ("order", "said"),
    [
        (WorldOrder("pause"), "paused"),
        (WorldOrder("resume"), "goes on"),
        (WorldOrder("step"), "makes 1 tick"),
        (WorldOrder("step", steps=50), "makes 50 ticks"),
        (WorldOrder("reset"), "all are back at their starts"),
        (WorldOrder("reset", name="KH01"), "KH01 is back at its start"),
        (WorldOrder("remove", name="KH01"), "KH01 is out"),
        (WorldOrder("spawn", name="KH01"), "KH01 is in"),
        (
            WorldOrder("spawn", name="KH09", kind="khepera4", at=(0.5, -0.5)),
            "KH09, a khepera4, is in at x = 0.5 m, y = -0.5 m",
        ),
        (WorldOrder("spawn", name="box1", obstacle={"radius": 0.1}, at=(1.0, 0.0)), "box1 is in at x = 1 m, y = 0 m"),
    ],
)
def test_what_was_done(order, said):
    assert done(order) == said
