"""States of several robots side by side, as tests compare them."""

import numpy as np

VALUES = (
    "time", "position", "velocity", "yaw", "true_position", "true_yaw", "battery", "flying", "received", "note",
    "refusal", "scan",
)  # fmt: skip


class Columns:
    """Values of the states: arrays of numbers, and the tuples `note`, `refusal` and `scan`."""

    def __init__(self, states):
        for name in VALUES:
            values = tuple(getattr(state, name) for state in states)
            setattr(self, name, values if name in {"note", "refusal", "scan"} else np.array(values))
