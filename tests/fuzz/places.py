"""The table of all places where bytes from outside are read."""

from __future__ import annotations

from tests.fuzz import targets_devices, targets_drones, targets_files, targets_network, targets_ros
from tests.fuzz.target import Place

PLACES: dict[str, Place] = {
    **targets_network.PLACES,
    **targets_drones.PLACES,
    **targets_devices.PLACES,
    **targets_ros.PLACES,
    **targets_files.PLACES,
}
