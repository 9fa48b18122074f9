"""Cameras with AprilTags, by rendered images: accuracy, cameras that were moved, tags that are there twice, faults."""

import re
import threading
from contextlib import contextmanager
from dataclasses import replace
from math import atan2, cos, hypot, inf, sin

import cv2
import msgspec
import numpy as np
import pytest

from agents.body.capture_reader import CaptureFrame
from agents.clock import uptime
from agents.ticks import Ticks
from bridges.motion_capture.cameras import coverage, file
from bridges.motion_capture.cameras.calibrate import BOARD, CalibrationError, calibrate, hang, print_sheets
from bridges.motion_capture.cameras.images import Images
from bridges.motion_capture.cameras.reader import CamerasReader
from bridges.motion_capture.cameras.tracker import Tracker
from bridges.motion_capture.cameras.vision import FLAT, CameraModel, TagDetector, in_space, on_floor, square
from bridges.motion_capture.publisher import PoseFilter
from bridges.motion_capture.twin.cameras import CamerasTwin, Sheet, jpeg
from bridges.motion_capture.twin.capture import upright
from tests.bridges.motion_capture.cameras_lab import CORNERS, FLOOR, Room, hung, moved, text
from tests.bridges.motion_capture.test_systems import ALL, BEGIN, FAULTS, LASTS, fault
from tests.cases import mostly_slow
from tests.waiting import PATIENCE_S, until
from twins.device import Faults, serve_until_next

WHEELS = {f"KH0{k}": (k, 0.10, 0.06, True) for k in (1, 2, 3)}
DRONES = {f"CF0{k}": (k + 3, 0.08, 0.03, False) for k in (1, 2, 3)}
TILT = 0.08  # standard deviation of a drone's tilt [rad]


def lab(bodies=None, **settings):
    return file.parse(text({**WHEELS, **DRONES} if bodies is None else bodies, **settings))


def through_jpeg(image):
    return cv2.imdecode(np.frombuffer(jpeg(image), np.uint8), cv2.IMREAD_GRAYSCALE)


def poses_at(k, names, rng):
    """True poses in image `k`: robots on circles; drones tilt."""
    poses = {}
    for row, name in enumerate(names):
        angle = 0.03 * k + 1.05 * row
        radius = 0.9 if row % 2 else 0.5
        height = 0.0 if name in WHEELS else 0.5 + 0.05 * row
        tilt = (0.0, 0.0) if name in WHEELS else rng.normal(0.0, TILT, 2)
        turn = cv2.Rodrigues(np.array([*tilt, 0.0]))[0] @ upright(angle)
        poses[name] = (radius * cos(angle), radius * sin(angle), height), turn
    return poses


def flown(seen, images=14, cameras="ABCD", room=None):
    """Distances [mm] and yaw errors [°] of all poses by name, of cameras that expose together."""
    room, rng = room or Room(seen), np.random.default_rng(2)
    tracker, found = Tracker(seen, print), {name: [] for name in seen.bodies}
    for k in range(images):
        true = poses_at(k, seen.bodies, rng)
        frames = [tracker.see(camera, 0.1 * k, through_jpeg(room.image(camera, true))) for camera in cameras]
        if k == 0:  # poses of the first camera alone: the others have seen nothing yet
            continue
        assert frames[-1][0] == pytest.approx(0.1 * k)
        for name, pose in frames[-1][1].items():
            if pose is not None:
                position, turn = true[name]
                away = 1e3 * float(np.linalg.norm(np.subtract(pose.position, position)))
                sine = turn[0, 0] * pose.rotation[3] - turn[1, 0] * pose.rotation[0]
                found[name].append((away, abs(np.degrees(np.arcsin(sine)))))
    return found


def test_four_cameras_measure_six_robots():
    found = flown(lab())
    for names, share in ((WHEELS, 1.0), (DRONES, 0.4)):
        each = np.array([one for name in names for one in found[name]])
        assert len(each) >= share * 3 * 13, "drones near a corner are seen by one camera"
        millimetres, degrees = np.percentile(each, 95, axis=0)
        assert millimetres <= 3.0
        assert degrees <= 2.0


def test_one_camera_measures_wheels_alone():
    found = flown(lab(cameras="A"), cameras="A")
    assert [one for name in DRONES for one in found[name]] == []
    each = [away for name in WHEELS for away, _ in found[name]]
    assert len(each) > 15
    assert np.percentile(each, 95) <= 5.0


def test_cameras_that_expose_apart_agree():
    """Two cameras 33 ms apart, 0.5 m/s: corners are taken at one time, or 17 mm would lie between them."""
    seen = lab({"CF01": (4, 0.10, 0.0, False)}, cameras="AC")
    room, tracker, errors = Room(seen), Tracker(seen, print), []

    def true(t):
        return {"CF01": ((0.5 * t - 0.3, 0.0, 0.5), upright(0.0))}

    for k in range(16):
        for camera, late in (("A", 0.0), ("C", 0.033)):
            t = 0.066 * k + late
            frame = tracker.see(camera, t, room.image(camera, true(t)))
            if frame is not None and (pose := frame[1]["CF01"]) is not None:
                errors.append(np.linalg.norm(np.subtract(pose.position, true(frame[0])["CF01"][0])))
    assert len(errors) > 7
    assert max(errors) < 0.003


@pytest.mark.parametrize("by", [(0.02, 0.0, 0.0), (0.0, 0.0, -0.05)])
def test_a_camera_that_was_moved_is_unused(by):
    seen = lab(cameras="ACB")
    there = msgspec.structs.replace(seen, measured={**seen.measured, "C": moved(seen.measured["C"], by)})
    room, said, rng = Room(there), [], np.random.default_rng(1)
    tracker = Tracker(seen, said.append)
    true = poses_at(0, seen.bodies, rng)
    for k in range(3):
        for camera in "ACB":
            frame = tracker.see(camera, 0.1 * k, room.image(camera, true))
    assert any(line.startswith("camera C was moved: floor tags are") for line in said)
    for name in WHEELS:
        assert np.linalg.norm(np.subtract(frame[1][name].position, true[name][0])) < 0.005


def test_a_camera_without_floor_tags_is_unused():
    seen, said = lab(cameras="A"), []
    room, tracker = Room(seen, floor={}), Tracker(seen, said.append)
    true = poses_at(0, seen.bodies, np.random.default_rng(1))
    assert set(tracker.see("A", 0.0, room.image("A", true))[1].values()) == {None}
    assert said == ["camera A sees no floor tag: unused, as it may have been moved"]


def test_a_tag_that_is_there_twice_is_dropped():
    bodies = {"KH01": (1, 0.10, 0.06, True), "KH02": (2, 0.10, 0.06, True)}
    seen = lab(bodies, cameras="AC")
    room, tracker = Room(seen), Tracker(seen, print)
    room.bodies = {**room.bodies, "copy": room.bodies["KH01"]}
    true = {"KH01": ((0.3, 0.0, 0.0), upright(0.0)), "KH02": ((-0.3, 0.0, 0.0), upright(0.0))}
    for k in range(2):
        for camera in "AC":
            image = room.image(camera, {**true, "copy": ((0.0, 0.4, 0.0), upright(0.0))})
            frame = tracker.see(camera, 0.1 * k, image)
    assert frame[1]["KH01"] is None
    assert frame[1]["KH02"] is not None


def test_a_silent_camera_stops_no_search():
    seen = lab(WHEELS, cameras="ABC")
    room, tracker = Room(seen), Tracker(seen, print)
    true = {"KH01": ((-0.4, -0.5, 0.0), upright(0.0)), "KH02": ((-0.8, -0.2, 0.0), upright(0.0))}
    for k in range(12):
        shown = dict([*true.items()][: 1 + (k > 5)])  # one robot, then two; B never has an image
        frames = [tracker.see(camera, 0.1 * k, room.image(camera, shown)) for camera in ("AC" if k == 0 else "A")]
    t, poses = frames[-1]
    assert t == pytest.approx(1.1)
    assert [poses[name] is None for name in WHEELS] == [False, False, True]


def test_images_of_another_size_are_unused():
    seen, said = lab(cameras="A"), []
    tracker = Tracker(seen, said.append)
    assert tracker.see("A", 0.0, np.zeros((480, 640), np.uint8)) is None
    assert said == ["camera A gives images of 640 x 480, and was calibrated with 1280 x 720: unused"]


def test_views_that_disagree_are_no_pose():
    one, other = (CameraModel(hung(CORNERS[name])) for name in "AC")
    corners = 0.1 * FLAT + np.array([0.1, 0.2, 0.5])
    views = [(camera, camera.project(corners)) for camera in (one, other)]
    centre, rotation = in_space(views, 0.1)
    assert centre == pytest.approx((0.1, 0.2, 0.5), abs=1e-6)
    assert rotation == pytest.approx(np.eye(3), abs=1e-5)
    assert in_space([(one, views[0][1] + 12.0), views[1]], 0.1) is None
    assert in_space(views[:1], 0.1) is None, "a camera does not know how far a tag is"
    assert in_space([views[0], views[0]], 0.1) is None, "nor do two at one place"
    assert on_floor(views, 0.1, 0.5)[0] == pytest.approx((0.1, 0.2, 0.5), abs=1e-6)
    assert on_floor(views, 0.1, 0.2) is None, "it stands on something"


def test_a_camera_straight_above_measures():
    """Corners are a perfect square there, at which OpenCV's own solution for squares fails."""
    above = CameraModel(hung((0.0, 0.0, 2.5), aim=(0.0, 0.0, 0.0)))
    for yaw in np.arange(-3.0, 3.0, 0.5):
        corners = square(0.1, 0.2, -0.1, yaw) + np.array([0.0, 0.0, 0.1])
        centre, rotation = on_floor([(above, above.project(corners))], 0.1, 0.1)
        assert centre == pytest.approx((0.2, -0.1, 0.1), abs=1e-6)
        assert np.arctan2(rotation[1, 0], rotation[0, 0]) == pytest.approx(yaw, abs=1e-6)


@pytest.mark.parametrize("half_turn", [False, True])
def test_places_come_from_the_floor(half_turn):
    """Also with the tags of the AprilTag project, which lie the other way round in OpenCV's eyes."""
    seen = lab()
    room, detector = Room(seen, floor={n: (x, y, np.pi * half_turn) for n, (x, y) in FLOOR.items()}), TagDetector(FLOOR)
    for name, true in seen.measured.items():
        corners = detector.whole(through_jpeg(room.image(name, {})))[0]
        bare = msgspec.structs.replace(true, place=(0.0, 0.0, 0.0), turn=(0.0, 0.0, 0.0))
        placed, error = hang(name, corners, seen.floor, bare)
        assert placed.half_turn == half_turn
        assert error < 1.0
        assert np.linalg.norm(np.subtract(placed.place, true.place)) < 0.01


def test_a_floor_tag_elsewhere_is_named():
    seen = lab(cameras="A")
    wrong = msgspec.structs.replace(seen.floor, tags={**seen.floor.tags, 22: (1.1, 1.2, 0.0)})
    corners = TagDetector(FLOOR).whole(Room(seen).image("A", {}))[0]
    with pytest.raises(CalibrationError, match="floor tag 22 lies elsewhere than"):
        hang("A", corners, wrong, seen.measured["A"])
    with pytest.raises(CalibrationError, match="sees of the floor tags 21, 22; it needs 3"):
        hang("A", {n: corners[n] for n in (21, 22)}, seen.floor, seen.measured["A"])


@pytest.mark.parametrize(
    ("wrong", "words"),
    [
        ("[bodies", "cameras.toml: Expected .* at the end of"),
        ("rate_hz = -1", r"rate_hz"),
        ('[cameras.X]\nsource = "rtsp://camera"', r"regex.*cameras"),
        ("[bodies.X]\ntag = 20\nsize = 0.1\nheight = 0", "tag 20 stands twice"),
        ("[bodies.X]\ntag = 587\nsize = 0.1\nheight = 0", r"586.*bodies"),
        (file.with_measured("", {"Z": hung((0.0, 0.0, 1.0), aim=(1.0, 0.0, 0.0))}), "measured.Z. is of no camera"),
    ],
)
def test_wrong_files_are_refused(wrong, words):
    content = text(WHEELS)
    content = wrong + "\n" + content.partition("\n")[2] if wrong.startswith("rate") else content + wrong
    with pytest.raises(file.CamerasFileError, match=words):
        file.parse(content)


def test_bodies_of_a_file_are_those_of_robots():
    content = text({**WHEELS, **DRONES})
    CamerasReader.check(content, "cameras.toml", {"KH01": False, "CF01": True})
    with pytest.raises(ValueError, match=r"no \[bodies.CF09\]; there are: KH01"):
        CamerasReader.check(content, "cameras.toml", {"CF09": True})
    with pytest.raises(ValueError, match=r"\[bodies.KH01\] is on_floor, but flies"):
        CamerasReader.check(content, "cameras.toml", {"KH01": True})
    with pytest.raises(ValueError, match="no camera is calibrated"):
        CamerasReader.check(content.partition(file.MARK)[0], "cameras.toml", {})


def test_calibration_replaces_what_was_measured():
    content = text(WHEELS)
    again = file.with_measured(content, {"A": hung(CORNERS["A"])})
    assert again.count(file.MARK) == 1
    read = file.parse(again)
    assert list(read.measured) == ["A"]
    assert read.bodies == file.parse(content).bodies


def test_small_tag_is_found_while_others_are_seen():
    """A drone on the floor: its tag has 12 px, and is found in enlarged images alone."""
    seen = lab({"KH01": WHEELS["KH01"], "CF01": DRONES["CF01"]})
    room, tracker = Room(seen), Tracker(seen, print)
    poses = {"KH01": (np.array([0.0, 0.2, 0.0]), upright(0.0)), "CF01": (np.array([-0.2, 0.4, 0.0]), upright(0.0))}
    frames = [tracker.see(name, 0.25 * k, room.image(name, poses)) for k in range(4) for name in "ABCD"]
    assert frames[-1] is not None
    assert frames[-1][1]["CF01"].position == pytest.approx((-0.2, 0.4, 0.0), abs=0.003)


PLANNED = "A.planned = { place = [-1.7, -1.7, 2.6], aim = [0.0, 0.0, 0.3], view_deg = 83.27 }\n"


def test_coverage_is_told_before_cameras_hang(tmp_path):
    path = tmp_path / "cameras.toml"
    lines = text({"KH01": (1, 0.10, 0.14, True), "CF01": (4, 0.08, 0.04, False)}, "A").partition(file.MARK)[0]
    path.write_text(lines)
    with pytest.raises(file.CamerasFileError, match=r"A is neither calibrated nor planned; write A\.planned = {"):
        list(coverage.report(path, (3.0, 3.0, 1.0)))
    path.write_text(lines.replace("[cameras.A]\n", "[cameras]\n" + PLANNED).replace("source", "A.source"))
    told = list(coverage.report(path, (2.0, 2.0, 1.0)))
    assert told[0] == "KH01, tag of 0.1 m: places of 2 x 2 m where one camera or more see it"
    assert "  a tag of 0.12 m is seen everywhere, or this one in images 1.2 times as wide" in told
    assert told[-1] == "  no larger tag is seen everywhere: more cameras, or hang and turn them otherwise"
    assert told[-3] == "    " + " ".join(["."] * coverage.STEPS), "a drone needs two"
    for room in ((0.0, 3.0, 1.0), (3.0, -3.0, 1.0), (3.0, 3.0, np.nan)):
        with pytest.raises(file.CamerasFileError, match=r"--room .*: write three sides of 0\.1 to 100 m"):
            list(coverage.report(path, room))
    path.write_text(path.read_text().replace("aim = [0.0, 0.0, 0.3]", "aim = [-1.7, -1.7, 2.6]"))
    with pytest.raises(file.CamerasFileError, match=r"aim is its place.*planned"):
        list(coverage.report(path, (2.0, 2.0, 1.0)))


def test_planned_cameras_are_tried_with_the_twin(tmp_path):
    lines = text({"KH01": (1, 0.2, 0.06, True)}, "A").partition(file.MARK)[0]
    planned = lines.replace("[cameras.A]\n", "[cameras]\n" + PLANNED).replace("source", "A.source")
    with pytest.raises(ValueError, match="no camera is calibrated; give each the key `planned`, or run"):
        CamerasReader.check(lines, "cameras.toml", {}, simulated=True)
    CamerasReader.check(planned, "cameras.toml", {}, simulated=True)
    with pytest.raises(ValueError, match="no camera is calibrated; run"):
        CamerasReader.check(planned, "cameras.toml", {})
    (tmp_path / "cameras.toml").write_text(planned)
    with served(["KH01"], tmp_path / "cameras.toml") as address:
        reader, frames = CamerasReader(address, 0, PATIENCE_S), []
        until(lambda: frames.extend(frame for frame in [reader.newest(0.2)] if frame and frame.poses["KH01"]) or frames)
        reader.close()
    assert frames[0].poses["KH01"].position == pytest.approx((0.2, -0.1, 0.0), abs=0.01)


@pytest.mark.slow
def test_tags_are_seen_where_coverage_says():
    """Of 240 places that were tried once 96 % were seen, of those not called so 59 %."""
    seen = lab({"CF01": (4, 0.08, 0.03, False)})
    room, body = Room(seen), seen.bodies["CF01"]
    cameras = [CameraModel(each) for each in seen.measured.values()]
    rng, found = np.random.default_rng(3), []
    while len(found) < 12:
        place = *rng.uniform(-1.5, 1.5, 2).tolist(), float(rng.uniform(0.0, 1.2))
        if coverage.is_seen(cameras, body, body.size, place):
            tracker, pose = Tracker(seen, print), {"CF01": (np.array(place), upright(0.5))}
            frames = [tracker.see(name, 0.3 * k, room.image(name, pose)) for k in range(4) for name in "ABCD"]
            found.append(any(frame and frame[1]["CF01"] for frame in frames))
    assert sum(found) >= 10


class Line:
    """A twin of two cameras, the tracker and the bridge's filter, without sockets, by the clock of the twin."""

    RATE_HZ = 10.0

    def __init__(self, folder, **faults):
        lines = text({"cf_1": (4, 0.2, 0.03, False), "kh": (1, 0.2, 0.06, True)}, "ACB", 10.0, **SMALL)
        (folder / "cameras.toml").write_text(lines)
        seen = file.parse(lines)
        self.twin = CamerasTwin(["cf_1", "kh"], file=str(folder / "cameras.toml"), faults=Faults(**faults))
        self.twin._flush = lambda *_: None
        self.twin.clients = {name: replace(self.twin.new_client(), streams=True, camera=name) for name in seen.cameras}
        self.said, self.published = [], []
        self.tracker = Tracker(seen, self.said.append)
        self.filter = PoseFilter({"CF01": "cf_1", "KH01": "kh"}, self.said.append)
        self.last, self.number = {}, 0

    def run(self, until):
        for k in range(1, round(until * self.RATE_HZ) + 1):
            t = k / self.RATE_HZ
            self.twin.place(0, np.array([0.3 * cos(t), 0.3 * sin(t), 0.5]), upright(t))
            self.twin.place(1, np.array([-0.4, 0.1 * t, 0.0]), upright(0.0))
            self.twin.advance(t)
            for name, client in self.twin.clients.items():
                self._take(name, client, t)

    def _take(self, name, client, t):
        head, _, rest = bytes(client.unsent).partition(b"\r\n\r\n")
        client.unsent.clear()
        length = re.search(rb"Content-Length: (\d+)", head)
        if length is None or rest[: int(length[1])] == self.last.get(name):
            return
        self.last[name] = rest[: int(length[1])]
        image = cv2.imdecode(np.frombuffer(self.last[name], np.uint8), cv2.IMREAD_GRAYSCALE)
        if image is None or (found := self.tracker.see(name, t, image)) is None:
            return
        self.number += 1
        frame = CaptureFrame(self.number, found[1], 0.0, "z")
        for robot, stamp, position, yaw in self.filter.filter_poses(frame, found[0]):
            self.published.append((robot, stamp, position, yaw))
            assert hypot(*position[:2]) < 1.0

    def count(self, robot, begin, end=inf):
        return sum(name == robot and begin <= stamp < end for name, stamp, *_ in self.published)


SMALL = {"size": (800, 600), "view_deg": 71.08}


@pytest.mark.parametrize("name", mostly_slow([*FAULTS, "damaged"], 4))
def test_each_fault_of_cameras(tmp_path, name):
    faults, hidden, _ = FAULTS.get(name, (fault(name), ALL, ""))
    line = Line(tmp_path, **faults)
    end = BEGIN + faults.get("capture_for_s", LASTS)
    line.run(end + 1.2)
    line.twin.clients.clear()
    line.twin.close()
    for robot in ALL:
        assert line.count(robot, 0.05, BEGIN - 0.01) >= 3 or name == "lost frames"
        assert line.count(robot, end + 0.6) >= 3, line.said
        during = line.count(robot, BEGIN + 0.1, BEGIN + 0.45)
        assert during == 0 if robot in hidden else during >= 1, (robot, line.said)


@pytest.mark.parametrize(("name", "size"), [("late", 0.2), ("turned", 0.5), ("stuck", 0.002)])
def test_faults_that_no_image_shows_pass(tmp_path, name, size):
    line = Line(tmp_path, **fault(name), capture_by=size)
    line.run(BEGIN + LASTS)
    line.twin.clients.clear()
    line.twin.close()
    during = [each for each in line.published if each[0] == "CF01" and 0.05 <= each[1] - BEGIN < LASTS - 0.05]
    assert len(during) >= 3
    for _, stamp, (x, y, z), yaw in during:
        t = {"late": stamp - size, "turned": stamp, "stuck": BEGIN}[name]
        assert (x, y, z) == pytest.approx((0.3 * cos(t), 0.3 * sin(t), 0.5), abs=0.01)
        if name != "stuck":
            assert cos(yaw - t - (size if name == "turned" else 0.0)) > 0.99


class Shown:
    """Images of a lab that is calibrated: the board wherever it is asked for, then the floor."""

    troubles = ""

    def __init__(self, lab, boards):
        self.room, self.boards = Room(lab), boards

    def newest(self, _timeout):
        sheet = next(self.boards, None)
        return [(name, 0.0, images.image([sheet[name]] if sheet else [])) for name, images in self.room.images.items()]


def board(camera, k, rng):
    """The board before a camera, each time elsewhere in its image."""
    outline = np.array([[-4.0, 3.0, 0.0], [4.0, 3.0, 0.0], [4.0, -3.0, 0.0], [-4.0, -3.0, 0.0]]) * 0.045
    far = 0.55 + 0.25 * rng.random()
    centre = np.array([0.52 * far * ((k % 3) - 1), 0.27 * far * ((k // 3 % 3) - 1), far])  # coordinates of the camera
    turn = cv2.Rodrigues(rng.uniform(-0.5, 0.5, 3))[0] @ np.diag([1.0, -1.0, -1.0])
    return Sheet(BOARD.generateImage((800, 600)), (centre + outline @ turn.T) @ camera.rotation + camera.place)


@pytest.mark.slow
def test_a_lab_is_calibrated_by_board_and_floor(tmp_path):
    true, rng, said = lab(cameras="A"), np.random.default_rng(3), []
    models = {name: CameraModel(each) for name, each in true.measured.items()}
    boards = iter([{name: board(each, k, rng) for name, each in models.items()} for k in range(60)])
    bare = file.parse(text(WHEELS, "A").partition(file.MARK)[0])
    measured = calibrate(bare, Shown(true, boards), said.append, again=False, limit_s=600.0)
    for name, each in measured.items():
        assert np.linalg.norm(np.subtract(each.place, true.measured[name].place)) < 0.03
        assert each.matrix == pytest.approx(true.measured[name].matrix, rel=0.02)
    assert said[0].startswith("move the board about before A: near")
    seen = file.parse(file.with_measured(text(WHEELS, "A"), measured))
    errors = [away for away, _ in flown(seen, 6, "A", Room(lab(WHEELS, cameras="A")))["KH01"]]
    assert max(errors) < 10.0
    silent = Shown(true, iter([]))
    silent.room.images, silent.troubles = {}, "A: 404 Not Found"
    with pytest.raises(CalibrationError, match="no image in 0 s from A: 404 Not Found"):
        calibrate(bare, silent, said.append, again=False, limit_s=600.0, first_s=0.0)
    with pytest.raises(CalibrationError, match=r"not seen often enough \(A: 0 of 15 views\)"):
        calibrate(bare, Shown(true, iter([])), said.append, again=False, limit_s=0.0)


def test_tags_are_printed_in_their_size(tmp_path):
    (tmp_path / "cameras.toml").write_text(text(WHEELS))
    print_sheets(tmp_path / "cameras.toml", tmp_path / "tags.html")
    page = (tmp_path / "tags.html").read_text()
    assert page.count("<figure>") == len(FLOOR) + len(WHEELS) + 1
    assert page.count("width:200mm") == len(FLOOR)


def test_a_video_file_is_a_camera(tmp_path):
    """As OpenCV gives the images of a webcam."""
    seen = lab(cameras="A")
    writer = cv2.VideoWriter(str(tmp_path / "a.avi"), cv2.VideoWriter.fourcc(*"MJPG"), 10.0, (1280, 720))
    image = Room(seen).image("A", {})
    for _ in range(20):
        writer.write(cv2.cvtColor(image, cv2.COLOR_GRAY2BGR))
    writer.release()
    table = file.CameraTable(str(tmp_path / "a.avi"))
    images = Images(msgspec.structs.replace(seen, cameras={"A": table, "B": file.CameraTable(str(tmp_path / "b.avi"))}))
    came = []
    until(lambda: came.extend(images.newest(0.2)) or came)
    until(lambda: images.troubles == f"B: {tmp_path}/b.avi is not there")
    images.close()
    name, exposed, grey = came[0]
    assert (name, grey.shape) == ("A", (720, 1280))
    assert abs(exposed - uptime()) < PATIENCE_S
    assert np.abs(grey.astype(float) - image).mean() < 4.0


@contextmanager
def served(bodies, path, port=0):
    """Address of a twin that sees the first body at (0.2, -0.1), turned by 0.5 rad."""
    twin, over = CamerasTwin(bodies, file=str(path), port=port), threading.Event()
    twin.place(0, np.array([0.2, -0.1, 0.0]), upright(0.5))

    def serve():
        ticks = Ticks(20.0, clock=uptime)
        while not over.is_set():
            twin.advance(serve_until_next(twin, ticks))

    thread = threading.Thread(target=serve)
    thread.start()
    try:
        yield twin.address
    finally:
        over.set()
        thread.join()
        twin.close()


def test_images_come_over_http(tmp_path):
    """A server of the twin, and the reader with its threads; a camera that ends is connected again."""
    (tmp_path / "cameras.toml").write_text(text({"KH01": (1, 0.16, 0.06, True)}, "AC", 20.0, **SMALL))

    def seen():
        frame = reader.newest(0.2)
        frames.extend([frame] if frame and frame.poses["KH01"] else [])
        return len(frames) > count

    frames, count = [], 0

    with pytest.raises(OSError, match=r"A: .*refused, C: .*refused"):
        CamerasReader(f"{tmp_path}/cameras.toml@127.0.0.1:9", 0, 0.5)
    with served(["KH01"], tmp_path / "cameras.toml") as address:
        reader = CamerasReader(address, 0, PATIENCE_S)
        until(seen)
        frame = frames[0]
        x, y, z = frame.poses["KH01"].position
        assert (x, y, z) == pytest.approx((0.2, -0.1, 0.0), abs=0.005)
        assert atan2(frame.poses["KH01"].rotation[3], frame.poses["KH01"].rotation[0]) == pytest.approx(0.5, abs=0.05)
        assert frame.latency_s > 0.0
    with served(["KH01"], tmp_path / "cameras.toml", int(address.rpartition(":")[2])):
        count = len(frames) + 3
        until(seen)
        reader.close()
