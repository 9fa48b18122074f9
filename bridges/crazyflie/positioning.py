"""Setup of a Crazyflie's positioning system and estimator, and the wait until the estimate has settled."""

from __future__ import annotations

import time
from collections import deque
from collections.abc import Callable, Mapping, Sequence
from math import inf
from typing import Any, Final

import msgspec

from agents.body.interface import BodyError
from agents.clock import uptime, wait_until
from agents.vectors import Vector
from bridges.crazyflie.geometry import StationFile, Sweep, check_anchors, stations
from bridges.crazyflie.link import REPEAT_S, CrazyflieLink, LinkError
from bridges.crazyflie.protocol import crtp
from bridges.crazyflie.protocol.addresses import CrazyflieSettings, Lighthouse, Loco, Outside

ESTIMATORS: Final = {"auto": 0, "complementary": 1, "kalman": 2, "ukf": 3}
LOCO_MODES: Final = {"auto": 0, "twr": 1, "tdoa2": 2, "tdoa3": 3}
UPLOAD_S: Final = 8.0
ANCHORS_S: Final = 5.0  # an anchor gets its position by radio, and confirms it once per second
AGREE: Final = 1e-3  # [m]
SINGLE: Final = 1e-5  # relative tolerance of what a Crazyflie stores in single precision
RESET_S: Final = 0.1  # duration of the estimator's reset
VARIANCE_HZ: Final = 10.0  # beside poses, for which the budget of the radio is meant
SETTLED_SPREAD: Final = 1e-3  # [m²] settled: the variances of half a second differ by less,
SETTLED_BELOW: Final = 0.1  # [m²] limit of all of them
SAMPLES: Final = 5
VARIANCES: Final = {f"kalman.varP{axis}": "float" for axis in "XYZ"}

GEOMETRY: Final = "geometry of the base stations"


def configure(link: CrazyflieLink, settings: CrazyflieSettings) -> None:
    """Set up estimator and positioning; raises BodyError if the Crazyflie cannot, LinkError if no answer comes.

    A geometry is checked before anything is sent.
    """
    system, geometry = settings.positioning, None
    if isinstance(system, Loco):
        check_anchors(system.anchors)
    elif isinstance(system, Lighthouse) and system.file is not None:
        geometry = stations(system.file, system.base_stations)
    estimator = settings.estimator or (None if system is None else "kalman")
    if estimator is not None:
        link.set_parameter("stabilizer.estimator", ESTIMATORS[estimator])
    if settings.multiranger and not link.parameter_value("deck.bcMultiranger"):
        raise BodyError("no Multi-ranger deck found: without it all ranges are 0; is it on top, the right way round?")
    if isinstance(system, Lighthouse):
        _lighthouse(link, system, geometry)
    elif isinstance(system, Loco):
        _prepare_loco(link, system)
    elif isinstance(system, Outside):
        link.set_parameter("locSrv.extPosStdDev", system.position_sigma)
        link.set_parameter("locSrv.extQuatStdDev", system.attitude_sigma)


class Convergence:
    """Reset of the position estimator and the wait until it has settled; never blocks."""

    def __init__(self, link: CrazyflieLink, start: Vector, yaw: float, *, absolute: bool) -> None:
        """`start` [m] and `yaw` [rad]: pose on the ground; only positioning with attitude measures the yaw.

        `absolute`: positions are measured, so that their variance falls; a Flow deck measures velocities only.
        """
        self.done = False  # settled
        self._link, self._below = link, SETTLED_BELOW if absolute else inf
        self._variances: deque[tuple[float, ...]] = deque(maxlen=SAMPLES)
        place = {f"kalman.initial{axis}": value for axis, value in zip("XYZ", start, strict=True)}
        self._to_set = deque((place | {"kalman.initialYaw": yaw, "kalman.resetEstimation": 1.0}).items())
        self._to_set.append(("kalman.resetEstimation", 0.0))
        self._sent_at: float | None = None  # time of the last question about the first of these

    @property
    def reset(self) -> bool:
        """Whether the estimator has been reset."""
        return not self._to_set

    def advance(self, now: float) -> bool:
        """Continue at `now` on the clock `uptime` [s]; True once the estimate has settled."""
        while self._to_set and not self._set(now, *self._to_set[0]):
            return False
        if not self.done and len(self._variances) == SAMPLES:
            spread = [max(axis) - min(axis) for axis in zip(*self._variances, strict=True)]
            low = all(variance < self._below for sample in self._variances for variance in sample)  # NaN is not
            if low and max(spread) < SETTLED_SPREAD:
                self.done = True
                self._link.stop_log("variance")
        return self.done

    def _set(self, now: float, name: str, value: float) -> bool:
        """Set one parameter after the other, each confirmed; True when there is nothing to wait for."""
        if self._sent_at is not None and self._link.parameter_answer(name) is not None:
            if value == 1.0 and name == "kalman.resetEstimation" and now < self._sent_at + RESET_S:
                return False
            self._to_set.popleft()
            self._sent_at = None
            if not self._to_set:
                self._link.stop_log("variance")
                self._link.start_log("variance", VARIANCE_HZ, VARIANCES, self._store_variances)
            return True
        if self._sent_at is None or now > self._sent_at + REPEAT_S:
            self._sent_at = now
            self._link.send_parameter(name, value)
        return False

    def _store_variances(self, _t: float, _stamp: int, values: Mapping[str, float]) -> None:
        self._variances.append(tuple(values.values()))


def _lighthouse(link: CrazyflieLink, system: Lighthouse, wanted: StationFile | None) -> None:
    from cflib.crazyflie import mem  # noqa: PLC0415 - an optional extra
    from cflib.localization.lighthouse_config_manager import LighthouseConfigWriter  # noqa: PLC0415

    if not link.parameter_value("deck.bcLighthouse4"):
        raise BodyError("no Lighthouse deck found: is the deck on top of the drone, the right way round?")
    if wanted is None:
        return
    geometries, calibrations = {}, {}
    for number, geometry in wanted.geos.items():
        geometries[number] = mem.LighthouseBsGeometry.from_file_object(msgspec.to_builtins(geometry))
    for number, calibration in wanted.calibs.items():
        calibrations[number] = mem.LighthouseBsCalibration.from_file_object(msgspec.to_builtins(calibration))
    helper = mem.LighthouseMemHelper(link.cf)
    if (
        link.parameter_value("lighthouse.systemType") == wanted.system_type
        and _same_geometry(_await_answer(link, helper.read_all_geos, GEOMETRY), wanted)
        and _same_calibration(_await_answer(link, helper.read_all_calibs, GEOMETRY), wanted)
    ):
        return  # each writing wears the flash memory
    # naming the version erases the stored geometry, and takes a second
    version = None if link.parameter_value("lighthouse.systemType") == wanted.system_type else wanted.system_type
    writer = LighthouseConfigWriter(link.cf, system.base_stations)
    stored = _await_answer(
        link,
        lambda done: writer.write_and_store_config(done, geos=geometries, calibs=calibrations, system_type=version),
        GEOMETRY,
    )
    if not stored:
        raise BodyError(f"the firmware does not know {system.base_stations} base stations: lower base_stations")
    if not _same_geometry(_await_answer(link, helper.read_all_geos, GEOMETRY), wanted):
        raise BodyError("a base station was not stored: write the geometry with the Crazyflie client once")


def _same_geometry(found: Mapping[int, Any], wanted: StationFile) -> bool:
    """Whether the Crazyflie has the geometry of a file, as cflib reads it."""
    return all(
        number in found
        and found[number].valid
        and _agree(found[number].origin, geometry.origin)
        and all(map(_agree, found[number].rotation_matrix, geometry.rotation))
        for number, geometry in wanted.geos.items()
    )


def _same_calibration(found: Mapping[int, Any], wanted: StationFile) -> bool:
    """Whether the Crazyflie has the calibration of a file, as cflib reads it."""
    return all(
        number in found
        and found[number].valid
        and found[number].uid == calibration.uid
        and all(
            _agree([getattr(has, name) for name in Sweep.__struct_fields__], msgspec.structs.astuple(sweep), 1e-8)
            for has, sweep in zip(found[number].sweeps, calibration.sweeps, strict=True)
        )
        for number, calibration in wanted.calibs.items()
    )


def _agree(found: Sequence[float], wanted: Sequence[float], within: float = AGREE) -> bool:
    """Whether numbers that were read back are the wanted ones, `within` and single precision."""
    return all(abs(has - want) <= within + SINGLE * abs(want) for has, want in zip(found, wanted, strict=True))


def _prepare_loco(link: CrazyflieLink, system: Loco) -> None:
    from cflib.crazyflie.mem import MemoryElement  # noqa: PLC0415 - an optional extra

    memories = link.cf.mem.get_mems(MemoryElement.TYPE_LOCO2)
    if not memories or not (link.parameter_value("deck.bcLoco") or link.parameter_value("deck.bcDWM1000")):
        raise BodyError("no Loco positioning deck found: is the deck there, the right way round?")
    link.set_parameter("loco.mode", LOCO_MODES[system.mode])
    wanted = dict(enumerate(system.anchors))
    deadline = uptime() + ANCHORS_S
    missing = wanted
    while missing:
        for anchor, place in missing.items():
            link.cf.loc.send_short_lpp_packet(anchor, bytes((crtp.ANCHOR_POSITION,)) + crtp.VECTOR.pack(*place))
        time.sleep(RESET_S)
        known = _anchors(link, memories[0])
        missing = {
            anchor: place for anchor, place in wanted.items() if anchor not in known or not _agree(known[anchor], place)
        }
        if missing and uptime() > deadline:
            raise BodyError(f"anchor {min(missing)} did not store its position: is it on, in mode {system.mode}?")
    if not wanted and len(_anchors(link, memories[0])) == 0:
        raise BodyError("no anchor knows its position: write positioning.anchors = [[x, y, z], ...]")


def _anchors(link: CrazyflieLink, memory: Any) -> dict[int, tuple[float, float, float]]:  # noqa: ANN401 - cflib's
    """Positions [m] that the anchors report."""
    listed = _await_answer(link, memory.update_id_list, "list of anchors")
    if listed.nr_of_anchors == 0:
        return {}
    read = _await_answer(link, memory.update_data, "positions of anchors")
    return {number: anchor.position for number, anchor in read.anchor_data.items() if anchor.is_valid}


def _await_answer(link: CrazyflieLink, ask: Callable[[Callable[[Any], None]], object], what: str) -> Any:  # noqa: ANN401 - cflib's own objects
    """Call `ask` with a callback, and return the callback's argument; raises LinkError if cflib never calls back."""
    answers: list[object] = []
    ask(answers.append)
    wait_until(lambda: answers or link.error is not None, UPLOAD_S)
    if not answers:
        raise LinkError(f"no answer: {what}")
    return answers[0]
