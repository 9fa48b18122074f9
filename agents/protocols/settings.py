"""The `device` table of a robot in the experiment file, as the device's own struct."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, TypeVar

import msgspec

from agents.body import BodyError

SettingsT = TypeVar("SettingsT", bound=msgspec.Struct)


def settings(kind: type[SettingsT], robot: str, device: Mapping[str, Any]) -> SettingsT:
    """The settings of a robot's device.

    Raises:
        BodyError: If a field is unknown or wrong, naming the robot, the field and the fields that there are.
    """
    try:
        return msgspec.convert(dict(device), kind)
    except msgspec.ValidationError as error:
        known = ", ".join(kind.__struct_fields__)
        raise BodyError(f"{robot}: device: {error}; its fields are {known}") from error
