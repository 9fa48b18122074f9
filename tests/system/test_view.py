"""The view in a browser: robots that move in the page, the emergency stop, an observer's page, replay, many robots."""

from __future__ import annotations

import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import pytest

from agents.network import messages, pubsub
from agents.network.endpoints import free_endpoint
from experiments.file import document
from experiments.run import simulate
from experiments.scene.stage import Condition, Moment, Stage
from tests.conftest import RouterProcess
from tests.system.browser import needs_chromium, opened
from tests.system.lab import NEAR, ROOT, Flight, RobotProcess, Started, Watcher, zenpark

pytest.importorskip("viser", reason="needs viser")
pytestmark = [pytest.mark.system, needs_chromium]


class ViewProcess(Started):
    """`./zenpark view`."""

    def __init__(self, *arguments: object) -> None:
        self.port = int(free_endpoint(preferred_port=0).rpartition(":")[2])
        super().__init__("tools.guard", "view", *map(str, arguments), "--port", str(self.port))

    @property
    def address(self) -> str:
        """Of the page, when it is there."""
        assert self.process.stdout is not None
        line = self.process.stdout.readline()
        assert line.startswith(f"http://127.0.0.1:{self.port}"), line + self.process.stdout.read()
        return line.split()[0]


@contextmanager
def viewed(*arguments: object) -> Iterator[str]:
    """The address of a page, while its process runs."""
    process = ViewProcess(*arguments)
    try:
        yield process.address
    finally:
        assert process.end() == 0


@pytest.mark.mechanism("view")
def test_seven_robots_move_links_change_colour_and_the_button_stops_all(tmp_path: Path) -> None:
    read = document.load("robotic-park", *NEAR[1::2], "duration_s=60")
    park = read.cases()["event"]
    file = tmp_path / "event.json"
    file.write_bytes(document.write_json(park))
    router = RouterProcess()
    robots = RobotProcess(router.endpoint, file, *park.robots)
    watcher = Watcher(router.endpoint)
    try:
        told = pubsub.pose_publisher(watcher.session, watcher.keys.experiment, messages.JSON)
        told.put(document.case_document(park))
        with viewed("--connect", router.endpoint) as address, opened(address, 640, 480) as page:
            names = list(park.robots)
            watcher.until(lambda: all(watcher.phase(name) == "ready" for name in names), "ready")
            assert all(watcher.order(name, messages.Order("takeoff")).ok for name in names)
            watcher.until(lambda: all(watcher.phase(name) == "airborne" for name in names), "airborne")
            kinds = [f"/case/robots/{kind}/body" for kind in ("turtlebot3", "khepera4", "crazyflie")]
            page.until(lambda: all(name in page.nodes for name in kinds), "drawn")

            def places() -> np.ndarray:
                return np.concatenate([page.positions(name) for name in kinds])

            page.until(lambda: np.all(places()[:, 2] > -1.0), "seen")
            before, colours = places(), page.nodes["/case/links"]["colors"]
            at = time.time() + 0.5
            assert all(watcher.order(name, messages.Order("start", at=at)).ok for name in names)
            page.until(lambda: (np.linalg.norm(places() - before, axis=1) > 0.01).sum() >= 6, "followers move")
            assert watcher.order("TB01", messages.Order("go", goal=(-0.4, 0.8))).ok
            page.until(lambda: np.all(np.linalg.norm(places() - before, axis=1) > 0.01), "the leader moves")
            page.until(lambda: page.nodes["/case/links"]["colors"] != colours, "links change colour")
            page.button("EMERGENCY STOP").click()
            page.until(lambda: page.page.get_by_text("stopped: CF01, CF02").count(), "answers are shown")
            watcher.until(
                lambda: all(watcher.status[name].reason.startswith("emergency stop by operator") for name in names),
                "their statuses say so",
            )
            assert page.hosts == {address.removeprefix("http://")}
    finally:
        watcher.close()
        robots.kill()
        router.kill()


def test_an_observer_of_a_lab_has_no_buttons(tmp_path: Path) -> None:
    file = tmp_path / "triangle.toml"
    text = (ROOT / "experiments" / "catalogue" / "triangle.toml").read_text("utf-8")
    file.write_text(text + '\n[network]\nlab = "lab"\n', "utf-8")
    assert zenpark("cert", "init", tmp_path / "lab", file).returncode == 0
    flight = Flight(tmp_path / "run", str(file), "--case", "event", "--no-report", "--set", "duration_s=90")
    flight.until_said("phase conductor: formation")
    endpoint, _, lab = flight.endpoint().partition("#lab=")
    for identity, buttons in (("observer", 0), ("operator", 1)):
        with (
            viewed("--connect", endpoint, "--lab", lab, "--as", identity) as address,
            opened(address, 640, 480) as page,
        ):
            page.until(lambda: "/case/robots/khepera4/body" in page.nodes, "drawn")
            page.until(lambda: np.all(page.positions("/case/robots/khepera4/body")[:, 2] > -1.0), "seen")
            assert page.button("EMERGENCY STOP").count() == buttons
            assert page.button("Land all").count() == buttons
    assert zenpark("estop", "--connect", endpoint, "--lab", lab).returncode == 0
    flight.finish()


def test_the_slider_moves_robots_to_where_the_recording_says(tmp_path: Path) -> None:
    run = simulate(document.load("robotic-park", "duration_s=6", "timeline=[]"), cases=["event"], folder=tmp_path)
    trace = run.traces["event"]
    rows = [trace.robots.index(name) for name in ("CF01", "CF02", "CF03")]
    with viewed(tmp_path) as address, opened(address, 640, 480) as page:
        page.until(lambda: "/case0/robots/crazyflie/body" in page.nodes, "drawn")
        time_box = page.page.locator("input[type=text]").nth(0)
        for t in (4.0, 0.5, 2.5):
            wanted = trace.true_position[int(np.searchsorted(trace.time, t - 1e-6)), rows]
            time_box.fill(str(t))
            time_box.press("Enter")
            page.until(
                lambda wanted=wanted: np.abs(page.positions("/case0/robots/crazyflie/body") - wanted).max() < 1e-3,
                f"robots are where they were at {t} s",
            )
        page.button("Play").click()
        before = page.positions("/case0/robots/crazyflie/body").copy()
        page.until(lambda: np.any(page.positions("/case0/robots/crazyflie/body") != before), "it plays")
        assert page.hosts == {address.removeprefix("http://")}


def test_a_hundred_robots_are_drawn_at_twenty_frames_a_second() -> None:
    from experiments.scene.drawing import LIGHT, SceneDrawing  # noqa: PLC0415 - viser may be missing
    from experiments.view.live import ShowFolder, close_server, look_at, open_server  # noqa: PLC0415

    crowd = document.loads(
        'title = "a hundred"\nduration_s = 9.0\narena = { size = [12.0, 12.0, 3.0] }\n'
        + "".join(
            f'[robots.R{k}]\nkind = "{("khepera4", "crazyflie")[k % 2]}"\nstart = [{k % 10 - 4.5}, {k // 10 - 4.5}]\n'
            + ("hover = 0.6\n" if k % 2 else "")
            for k in range(100)
        )
        + "[formation.links]\n"
        + "".join(f'"R{k} > R{k + 1}" = 1.0\n' for k in range(99))
    ).cases()["default"]
    crowd_stage = Stage.of_experiment(crowd)
    server = open_server(int(free_endpoint(preferred_port=0).rpartition(":")[2]), "many", dark=False)
    drawing, show = SceneDrawing(server, crowd_stage, LIGHT), ShowFolder(server)
    show.fit(crowd_stage)
    drawing.shown = show.shown
    look_at(server, (12.0, 12.0, 3.0))
    over = threading.Event()
    moment = Moment.unknown(crowd_stage)
    grid = np.array([[k % 10 - 4.5, k // 10 - 4.5, 0.6 * (k % 2)] for k in range(100)])
    moment.condition[:], moment.yaw[:] = Condition.ACTIVE, 0.0

    def move() -> None:
        step = 0
        while not over.wait(1.0 / 30.0):
            step += 1
            moment.position = grid + 0.2 * np.sin(0.1 * step)
            moment.goal, moment.error = grid, np.full(len(crowd_stage.links), 0.03)
            ages = 0.1 * (step - 3.0 * np.arange(30))
            moment.trail = grid[:, None] + 0.2 * np.sin(ages)[None, :, None]
            with server.atomic():
                drawing.draw(moment, trails=step % 6 == 0)

    moving = threading.Thread(target=move)
    moving.start()
    try:
        with opened(f"http://127.0.0.1:{server.get_port()}", 480, 320) as page:
            page.until(lambda: "/case/robots/crazyflie/body" in page.nodes, "drawn")
            page.until(lambda: np.all(page.positions("/case/robots/crazyflie/body")[:, 2] > -1.0), "seen")
            rates = []
            while len(rates) < 8 and max(rates, default=0.0) < 20.0:
                rates.append(page.frames_alone())
            assert max(rates) >= 20.0, rates
    finally:
        over.set()
        moving.join()
        close_server(server)
