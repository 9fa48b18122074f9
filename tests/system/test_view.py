"""The view in a browser: robots that move in the page, the emergency stop, an observer's page, replay, many robots."""

import time
from contextlib import contextmanager
from functools import partial

import numpy as np
import pytest

from agents.decision.lifecycle import PAUSED
from agents.network import messages, pubsub
from agents.network.endpoints import free_endpoint
from experiments.file import document
from experiments.run import simulate
from experiments.view import acting
from tests.system.browser import needs_chromium, opened
from tests.system.lab import NEAR, Flight, RobotProcess, Started, in_lab, typed

pytest.importorskip("viser", reason="needs viser")
pytestmark = [pytest.mark.system, needs_chromium]


class ViewProcess(Started):
    """`./zenpark view`."""

    def __init__(self, *arguments, port=None):
        self.port = port or int(free_endpoint(preferred_port=0).rpartition(":")[2])
        super().__init__("tools.guard", "view", *map(str, arguments), "--port", str(self.port))

    def address(self):
        """Of the page, when it is there."""
        line = self.process.stdout.readline()
        assert line.startswith(f"http://127.0.0.1:{self.port}"), line + self.process.stdout.read()
        return line.split()[0]


@contextmanager
def viewed(*arguments):
    """A page, while its process runs."""
    with ViewProcess(*arguments) as process:
        yield process
        assert process.end() == 0


KINDS = ("turtlebot3", "khepera4", "crazyflie")  # of the reference experiment


def drawn_places(page, what="robots/{}/body", root="/case"):
    """Positions (7, 3) of the robots of the reference experiment in the page [m], or of what else it draws of them."""
    names = [f"{root}/{what.format(kind)}" for kind in KINDS]
    page.until(lambda: all(name in page.nodes for name in names), "drawn")
    return np.concatenate([page.positions(name) for name in names])


@contextmanager
def announced(watcher, endpoint, plan, folder):
    """Names of the robots of a case, which are there, and a conductor has announced it."""
    file = folder / "event.json"
    file.write_bytes(document.write_json(plan))
    told = pubsub.pose_publisher(watcher.session, watcher.keys.experiment, messages.JSON)
    told.put(document.case_document(plan, "event"))
    robots = RobotProcess(endpoint, file, *plan.names)
    try:
        yield plan.names
    finally:
        robots.kill()
        told.undeclare()


@pytest.mark.mechanism("view")
def test_page_shows_seven_robots_and_stops_all(router, watcher, tmp_path):
    low = (f"robots.{name}.hover=0.2" for name in ("CF01", "CF02", "CF03"))  # soon airborne
    park = document.load("robotic-park", *NEAR, *low, "duration_s=60").cases()["event"]

    def taken_off(view):
        watcher.until_all("ready", *names)
        watcher.give(messages.Order("takeoff"), *names)
        return view.address()

    with (
        announced(watcher, router.endpoint, park, tmp_path) as names,
        viewed("--connect", router.endpoint) as view,
        opened(partial(taken_off, view), 480, 360) as page,
    ):
        watcher.until_all("airborne", *names)
        page.until(lambda: np.all(drawn_places(page)[:, 2] > -1.0), "seen")
        before, colours = drawn_places(page), page.nodes["/case/links"]["colors"]
        watcher.start(*names)
        watcher.give(messages.Order("go", goal=(-0.4, 0.8)), "TB01")
        page.until(lambda: np.all(np.linalg.norm(drawn_places(page) - before, axis=1) > 0.01), "all move")
        page.until(lambda: page.nodes["/case/links"]["colors"] != colours, "links change colour")
        page.until(lambda: np.all(drawn_places(page, "goals/{}")[:, 2] > -1.0), "ghosts stand at the goals")
        page.until(lambda: page.page.get_by_text("event: formation").count(), "case and phase")
        page.button("EMERGENCY STOP").click()
        page.until(lambda: page.page.get_by_text("stopped: CF01, CF02").count(), "answers are shown")
        stopped = "emergency stop by operator"
        watcher.until(lambda: all(watcher.status[name].reason.startswith(stopped) for name in names), "they say so")
        assert page.hosts == {f"127.0.0.1:{view.port}"}


def test_cut_off_page_says_stop_not_sent(router):
    with ViewProcess("--connect", router.endpoint) as view, opened(view.address, 640, 480) as page:
        stop, alarm = page.button("EMERGENCY STOP"), page.page.get_by_text("EMERGENCY STOP NOT SENT")
        page.until(stop.count, "the page is there")
        place = stop.bounding_box()
        page.page.keyboard.press("Shift+S")
        page.until(page.page.get_by_text("no robot is seen").count, "answered")
        assert not alarm.count()
        view.process.kill()
        view.process.wait()
        page.page.keyboard.press("Shift+S")
        page.until(alarm.count, "the key has an answer")
        alarm.click()
        assert not alarm.count()
        page.page.mouse.click(place["x"] + 0.5 * place["width"], place["y"] + 0.5 * place["height"])
        page.until(alarm.count, "the button has an answer")
        page.until(page.page.get_by_text("CUT OFF", exact=False).count, "the page says why")
        with ViewProcess("--connect", router.endpoint, port=view.port) as other:
            other.address()
            page.until(page.page.get_by_text("of a former ./zenpark view").count, "it needs the new address")


def test_page_orders_reach_robots_and_become_events(router, watcher, tmp_path):
    convoy = document.load("convoy", "timeline=[]").cases()["event"]
    sent = pubsub.pose_subscriber(watcher.session, watcher.keys.event, 256, pubsub.EVENTS)
    heard, events = pubsub.Inbox(sent, messages.Event), []

    def recorded(text):
        events.extend(f"{event.kind} {event.source} {event.text}" for event in heard.read())
        return any(event.startswith(f"order operator {text}") for event in events)

    def everywhere(true):
        watcher.look()
        return all(true(watcher.status[name]) for name in names)

    with (
        announced(watcher, router.endpoint, convoy, tmp_path) as names,
        viewed("--connect", router.endpoint) as view,
        opened(view.address, 900, 600) as page,
    ):
        watcher.until_all("ready", *names)
        for order in (messages.Order("takeoff"), messages.Order("start", at=time.time() + 0.2)):
            watcher.give(order, *names)
        page.until(lambda: everywhere(lambda status: status.phase == "running"), "running")

        page.page.get_by_label("Drag targets").check()
        page.until(lambda: "/targets/TB01" in page.nodes, "the target is shown")
        start = np.array(convoy.experiment.robots["TB01"].start[:2])
        square = np.array([*start + 0.255 * acting.HANDLE * 3.0 / 2.5, 0.0])  # by which it is dragged in the plane
        place = page.nodes["/targets/TB01"]

        def dragged(by, answer):
            page.until(
                lambda: np.allclose(place.get("position", (np.inf,) * 3)[:2], start, atol=0.01), "it is at its goal"
            )
            del place["position"]  # it comes again when the target is back
            page.drag(square, square + np.array([*by, 0.0]))
            page.until(lambda: recorded(f"TB01 to {answer}"), f"sent: {events}")

        dragged((0.1, -1.2), "x = 0.10 m, y = -1.80 m: 0 of 1 robots; TB01: x = ")  # outside the arena
        dragged((0.4, 0.3), "x = 0.40 m, y = -0.30 m: 1 of 1 robots")
        page.until(lambda: (watcher.look(), watcher.state["TB01"].goal[0] > 0.1)[1], "the leader goes there")
        assert np.linalg.norm(np.subtract(watcher.state["TB01"].goal[:2], start)) < 0.5, "not at once"

        page.button("Hold all").click()
        page.until(lambda: recorded("hold: 4 of 4 robots"), "held")
        page.until(lambda: everywhere(lambda status: status.reason == PAUSED), "statuses say so")
        page.button("Resume all").click()
        page.until(lambda: recorded("resume: 4 of 4 robots"), "resumed")
        page.until(lambda: everywhere(lambda status: not status.reason), "statuses say so")

        page.page.get_by_role("slider").first.press("ArrowRight")
        page.until(lambda: recorded("trigger.threshold = 0.0102: 4 of 4 robots"), f"set: {events}")
        changed = [watcher.order(name, messages.Order("get", name="trigger.threshold")).value for name in names]
        assert changed == pytest.approx([0.0102] * 4)

        page.button("Land all").click()
        page.until(lambda: recorded("land: 4 of 4 robots"), "landed")
        page.until(lambda: everywhere(lambda status: status.phase == "done"), "statuses say so")


def test_lab_observer_watches_and_shift_s_stops_run(tmp_path):
    file = in_lab(tmp_path)
    flight = Flight(tmp_path / "run", file, "--case", "event", "duration_s=90")
    flight.until_flown()
    endpoint, _, lab = flight.endpoint().partition("#lab=")
    for identity, buttons in (("observer", 0), ("operator", 1)):
        with (
            viewed("--connect", endpoint, "--lab", lab, "--as", identity) as view,
            opened(view.address, 640, 480) as page,
        ):
            page.until(lambda: "/case/robots/khepera4/body" in page.nodes, "drawn")
            page.until(lambda: np.all(page.positions("/case/robots/khepera4/body")[:, 2] > -1.0), "seen")
            page.until(lambda: page.page.get_by_text("event: formation").count(), "case and phase, though it is late")
            for name in ("EMERGENCY STOP", "Land all", "Hold all", "Resume all"):
                assert page.button(name).count() == buttons
            sliders = page.page.get_by_role("slider")
            assert (sliders.count() > 0) == buttons
            if buttons:
                sliders.first.press("ArrowRight")
                page.until(lambda: page.page.get_by_text("3 of 3 robots").count(), "answers are shown")
            page.page.keyboard.press("Shift+S")
            if buttons:
                page.until(lambda: page.page.get_by_text("stopped: CF01, KH01, KH02").count(), "answers are shown")
    flight.finish()
    said = [event.text for event in typed(tmp_path / "run" / "event.mcap", "/events") if event.kind == "order"]
    assert said == ["trigger.threshold = 0.0102: 3 of 3 robots", "emergency stop: stopped: CF01, KH01, KH02"]


def test_slider_moves_robots_to_recorded_places(tmp_path):
    run = simulate(document.load("robotic-park", "duration_s=6", "timeline=[]"), cases=["event"], folder=tmp_path)
    trace = run.traces["event"]
    with viewed(tmp_path) as view, opened(view.address, 640, 480) as page:
        assert drawn_places(page, root="/case0").shape == trace.true_position[0].shape
        time_box = page.page.locator("input[type=text]").nth(0)
        for t in (4.0, 0.5, 2.5):
            wanted = trace.true_position[int(np.searchsorted(trace.time, t - 1e-6))]
            time_box.fill(str(t))
            time_box.press("Enter")
            page.until(
                lambda wanted=wanted: np.abs(drawn_places(page, root="/case0") - wanted).max() < 1e-3,
                f"robots are where they were at {t} s",
            )
        page.button("Play").click()
        before = drawn_places(page, root="/case0")
        page.until(lambda: np.any(drawn_places(page, root="/case0") != before), "it plays")
        assert page.hosts == {f"127.0.0.1:{view.port}"}
