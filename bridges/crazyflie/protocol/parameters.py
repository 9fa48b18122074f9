"""Firmware parameters that an experiment file may set: within four times of the firmware's own, no protection off."""

from __future__ import annotations

from collections.abc import Collection, Iterator, Mapping
from dataclasses import dataclass
from math import isfinite
from typing import Final, Literal

from agents.errors import did_you_mean
from bridges.crazyflie.protocol.tables import READ_ONLY, inventory

TIMES: Final = 4.0  # largest ratio of a value and the firmware's own, either way
CHOICES: Final = {"stabilizer.controller": (0, 7)}  # first and last number of what is a choice
# tumble check, crash detection, timeouts, voltages; speeds by the Flow deck
PROTECTIONS: Final = ("supervisor.", "pm.", "motion.disable")
# motors by hand, tests that turn propellers, modes of pilots, resets, and what zenpark sets from other settings
TAKEN: Final = (
    "motorPowerSet.", "health.", "system.", "powerDist.", "stabilizer.stop", "stabilizer.estimator", "flightmode.",
    "commander.enHighLevel", "hlCommander.groupmask", "kalman.resetEstimation", "kalman.initial", "locSrv.",
    "lighthouse.", "loco.", "memTst.", "ukf.resetEstimation", "usec.reset",
)  # fmt: skip


@dataclass(frozen=True)
class ParameterFault:
    """Reason against a value of a parameter, and the remedy."""

    name: str
    message: str
    remedy: str
    severity: Literal["error", "warning"] = "error"


def parameter_faults(chosen: Mapping[str, float], unprotected: Collection[str] = ()) -> Iterator[ParameterFault]:
    """Faults of parameters by name; `unprotected`: those that may change a protection."""
    known = {each.name: each for each in inventory().parameters.variables}
    for name, value in chosen.items():
        default = known[name].value if name in known else 0.0
        if name.startswith(TAKEN) or (name in known and known[name].flags & READ_ONLY):
            message = f"{name}: not for a file, as it turns motors, or zenpark or the drone sets it"
            yield ParameterFault(name, message, "leave it out; `estimator` and `positioning` are settings")
        elif name.startswith(PROTECTIONS) and name not in unprotected:
            message = f"{name} is a protection of the drone"
            yield ParameterFault(name, message, f'leave it out, or say it clearly: unprotected = ["{name}"]')
        elif name not in known:
            message = f"{name} is none of the {len(known)} parameters of the firmware that are known here"
            hint = did_you_mean(name, known) or "without it on board the drone is not ready"
            yield ParameterFault(name, message, hint, "warning")
        elif (whole := whole_numbers(known[name].type)) is not None and value not in whole:
            message = f"{name} = {value:g} cannot be held on board"
            yield ParameterFault(name, message, f"choose a whole number from {whole[0]} to {whole[-1]}")
        elif name in CHOICES:
            low, high = CHOICES[name]
            if value not in range(low, high + 1):
                yield ParameterFault(name, f"{name} = {value:g} is no choice", f"choose {low} to {high}")
        elif default and name not in unprotected and not default / TIMES <= value <= default * TIMES:
            message = f"{name} = {value:g} is far from the firmware's own {default:g}"
            most = default * TIMES if whole is None else min(default * TIMES, whole[-1])
            yield ParameterFault(name, message, f"choose {default / TIMES:g} to {most:g}")
        elif not isfinite(value) or value < 0.0:
            yield ParameterFault(name, f"{name} = {value:g} is no gain", "choose a value from 0 on")


def whole_numbers(kind: str) -> range | None:
    """Numbers that a type of whole numbers holds; None for others."""
    if kind[0] not in "ui":
        return None
    bits = int(kind[1:])
    return range(2**bits) if kind[0] == "u" else range(-(2 ** (bits - 1)), 2 ** (bits - 1))
