"""Shows a recording in rerun: `python docs/viewers/rerun_view.py RUN/event.mcap [--save FILE.rrd]`.

Needs `pip install rerun-sdk mcap-ros2-support`. Rerun draws /tf and the poses of a recording by itself, but not
visualization_msgs/MarkerArray: the scene is logged as rerun's own shapes, with the blueprint for the viewer.
"""

import sys
from pathlib import Path
from typing import Any

import numpy as np
import rerun as rr
import rerun.blueprint as rrb
from mcap.reader import make_reader
from mcap_ros2.decoder import DecoderFactory

CYLINDER, LINE_STRIP, LINE_LIST = 3, 4, 5  # types of visualization_msgs/Marker


EYE = np.array([1.5, -2.1, 1.75])  # in half lengths of the arena


def rgb(colour: Any) -> list[float]:  # noqa: ANN401 - of a decoder
    return [colour.r, colour.g, colour.b, colour.a]


def line(marker: Any, points: np.ndarray) -> rr.LineStrips3D:  # noqa: ANN401
    """Lines of a marker: one strip, or pairs of points."""
    strips = [points] if marker.type == LINE_STRIP else points.reshape(-1, 2, 3)
    colours = [rgb(each) for each in marker.colors[::2]] or [rgb(marker.color)]
    return rr.LineStrips3D(strips, colors=colours, radii=0.5 * marker.scale.x)


def half_length(file: str) -> float:
    """Of the arena, by the first scene of a recording [m]."""
    with Path(file).open("rb") as stream:
        reader = make_reader(stream, decoder_factories=[DecoderFactory()])
        for *_, scene in reader.iter_decoded_messages(["/scene"]):
            return max(abs(p.x) for marker in scene.markers if marker.ns == "arena" for p in marker.points)
    return 1.0


def main(file: str, save: str | None) -> None:
    rr.init("zenpark", spawn=save is None)
    eye = rrb.EyeControls3D(position=half_length(file) * EYE, look_target=(0.0, 0.0, 0.3), eye_up=(0.0, 0.0, 1.0))
    scene = rrb.Spatial3DView(origin="/", contents=["/arena/**"], name=file, eye_controls=eye)
    blueprint = rrb.Blueprint(scene, rrb.TimePanel(timeline="time"), collapse_panels=True)
    if save is not None:
        rr.save(save, default_blueprint=blueprint)
    else:
        rr.send_blueprint(blueprint)
    rr.log("/arena", rr.ViewCoordinates.RIGHT_HAND_Z_UP, static=True)
    known: set[int] = set()
    with Path(file).open("rb") as stream:
        reader = make_reader(stream, decoder_factories=[DecoderFactory()])
        for _, channel, message, decoded in reader.iter_decoded_messages(["/tf", "/scene"]):
            rr.set_time("time", timestamp=1e-9 * message.log_time)
            if channel.topic == "/tf":
                for each in decoded.transforms:
                    at, turn = each.transform.translation, each.transform.rotation
                    rr.log(
                        f"/arena/robots/{each.child_frame_id}",
                        rr.Transform3D(translation=[at.x, at.y, at.z], quaternion=[turn.x, turn.y, turn.z, turn.w]),
                    )
                continue
            for marker in decoded.markers:
                still = marker.ns in {"arena", "robots", "names"}  # never change, or move with their frames
                if still and marker.id in known:
                    continue
                known.add(marker.id)
                points = np.array([(p.x, p.y, p.z) for p in marker.points])
                if marker.type in (LINE_LIST, LINE_STRIP):
                    rr.log(f"/arena/{marker.ns}/{marker.id}", line(marker, points), static=still)
                elif marker.type == CYLINDER:
                    at, robot = marker.pose.position, marker.ns == "robots"
                    shape = rr.Ellipsoids3D if robot else rr.Cylinders3D
                    size = marker.scale
                    made = (
                        shape(half_sizes=[[0.5 * size.x, 0.5 * size.y, 0.5 * size.z]], colors=[rgb(marker.color)],
                              fill_mode="solid", centers=[[at.x, at.y, at.z]], labels=[marker.header.frame_id])
                        if robot
                        else shape(lengths=[size.z], radii=[0.5 * size.x], colors=[rgb(marker.color)],
                                   centers=[[at.x, at.y, at.z]])
                    )  # fmt: skip
                    where = f"robots/{marker.header.frame_id}/body" if robot else f"{marker.ns}/{marker.id}"
                    rr.log(f"/arena/{where}", made, static=still)


if __name__ == "__main__":
    main(sys.argv[1], sys.argv[3] if sys.argv[2:3] == ["--save"] else None)
