"""Public libraries read the twins of OptiTrack and Qualisys: each fault that they can notice."""

import asyncio
import math
import select
from xml.etree import ElementTree

import numpy as np
import pytest

from bridges.motion_capture.twin.capture import upright
from bridges.motion_capture.twin.optitrack import OptiTrackTwin
from bridges.motion_capture.twin.qualisys import QualisysTwin
from tests.bridges.motion_capture.test_systems import served
from twins.device import Faults

PLACES = {"cf_1": ((0.5, -1.25, 0.75), 0.4), "Rigid Body 2": ((-2.0, 0.25, 0.0625), -2.0)}
STEPS = 20  # frames
NAMED = ("cf_1", "Rigid Body 2")
FAULTS = {  # names, and those of tracked bodies, in the last frame
    "none": ({}, NAMED, NAMED),
    "lost frames": ({"loss": 0.3}, NAMED, NAMED),
    "occluded": ({"occluded_from_s": 0.1}, NAMED, ()),
    "renamed": ({"capture": "renamed"}, ("cf_1-renamed", "Rigid Body 2"), ("cf_1-renamed", "Rigid Body 2")),
    "missing": ({"capture": "missing"}, NAMED, ("Rigid Body 2",)),
}


def step(twin, k):
    """Answer requests, and send the frame of tick k."""
    for row, (position, yaw) in enumerate(PLACES.values()):
        twin.place(row, np.array(position), upright(yaw))
    for ready in select.select(twin.sockets(), [], [], 0.0)[0]:
        twin.serve(ready, 0.01 * k)
    twin.advance(0.01 * k)


def check(bodies, names, tracked):
    """Compare positions [m] and yaws [rad] by name, of tracked bodies, with their places."""
    assert bodies.keys() == {*tracked}
    for name, (position, yaw) in bodies.items():
        place, heading = PLACES[name.removesuffix("-renamed")]
        assert position == pytest.approx(place, abs=1e-6)
        assert math.cos(yaw - heading) == pytest.approx(1.0, abs=1e-9)
    assert {*bodies} <= {*names}


@pytest.mark.parametrize("version", ["3.0", "4.0", "4.2"])
@pytest.mark.parametrize("name", FAULTS)
def test_natnet_reads_the_twin(name, version):
    natnet = pytest.importorskip("natnet")
    faults, names, tracked = FAULTS[name]
    twin = OptiTrackTwin([*PLACES], version=version, faults=Faults(**faults))
    host, port = twin.address.split(":")
    client = natnet.NatNetClient(host, host, command_port=int(port), use_multicast=False)
    frames, described = [], []
    client.on_data_frame_received_event.handlers.append(frames.append)
    client.on_data_description_received_event.handlers.append(described.append)
    try:
        with served(twin):
            client.connect()
        for k in range(1, STEPS + 1):
            client.request_modeldef()
            step(twin, k)
            client.update_sync()
        while frames[-1].prefix.frame_number < twin.frames_sent and "loss" not in faults:
            client.update_sync()
    finally:
        client.shutdown()
        twin.close()
    known = {body.id_num: body.name for body in described[-1].rigid_bodies}
    assert sorted(known.values()) == sorted(names)
    bodies = {}
    for body in frames[-1].rigid_bodies:
        (x, y, z), (_, turn, _, w) = body.pos, body.rot  # y up
        if body.tracking_valid:
            bodies[known[body.id_num]] = (x, -z, y), 2.0 * math.atan2(turn, w)
    check(bodies, names, tracked)


@pytest.mark.parametrize("name", FAULTS)
def test_qtm_rt_reads_the_twin(name):
    qtm_rt = pytest.importorskip("qtm_rt")
    faults, names, tracked = FAULTS[name]
    twin = QualisysTwin([*PLACES], faults=Faults(**faults))
    host, port = twin.address.split(":")
    frames = []

    async def pump(k):
        step(twin, k)
        await asyncio.sleep(0.001)

    async def answered(request, begin):
        asked, k = asyncio.ensure_future(request), begin
        while not asked.done():
            await pump(k)
            k += begin > 0
        return asked.result()

    async def read():
        connection = await answered(qtm_rt.connect(host, int(port)), 0)
        await answered(connection.stream_frames(components=["6d"], on_packet=frames.append), 1)
        while frames[-1].framenumber < STEPS:
            await pump(twin.frames_sent + 1)
        parameters = await answered(connection.get_parameters(["6d"]), 0)
        connection.disconnect()
        await asyncio.sleep(0.0)
        return ElementTree.fromstring(parameters)

    try:
        parameters = asyncio.run(read())
    finally:
        twin.close()
    assert [body.findtext("Name") for body in parameters.iter("Body")] == [*names]
    _, poses = frames[-1].get_6d()
    if name == "missing":  # its frames have no names: only their number tells
        assert len(poses) == len(names) - 1
        return
    bodies = {}
    for body, (position, rotation) in zip(names, poses, strict=True):
        if math.isfinite(position.x):
            column = rotation.matrix  # column by column
            bodies[body] = tuple(each / 1000.0 for each in position), math.atan2(column[1], column[0])
    check(bodies, names, tracked)
