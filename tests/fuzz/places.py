"""The table of all places where bytes from outside are read."""

from __future__ import annotations

from tests.fuzz import targets_devices, targets_files, targets_network
from tests.fuzz.target import Place

PLACES: dict[str, Place] = {**targets_network.PLACES, **targets_devices.PLACES, **targets_files.PLACES}
