"""The replay inside a report: it stands alone, is small, moves robots to where they were."""

import json
import re

import numpy as np
import pytest

from experiments.report import replay, trajectories
from tests.runs import flown
from tests.system.browser import CHROMIUM, needs_chromium

pytestmark = pytest.mark.slow  # whole runs, drawn

CASES = ["periodic", "event"]


@pytest.fixture(scope="module")
def traces():
    return [flown("robotic-park", case, "duration_s=3.0", "timeline=[]").trace for case in CASES]


def film_of(page):
    return json.loads(re.search(r'getElementById\("film"\), (\{.*\})\);', page)[1])


def test_positions_match_the_run_within_a_millimetre(traces):
    page = replay.embedded(traces)
    assert "http" not in page
    assert page.count("</script>") == 1
    film = film_of(page)
    assert [case["name"] for case in film["cases"]] == CASES
    assert film["names"] == list(traces[0].robots)
    assert len(page) < 3e6
    for trace, case in zip(traces, film["cases"], strict=True):
        for k, sample in enumerate(case["p"]):
            at = int(np.argmin(np.abs(trace.time - k * case["step"])))
            assert np.array(sample).reshape(-1, 4)[:, :3] / 1e3 == pytest.approx(trace.true_position[at], abs=1e-3)


def test_the_still_picture_is_that_of_the_replay(traces):
    page = replay.embedded(traces)
    at = film_of(page)["still"]
    still = page[page.index("<svg") : page.index("</svg>")]
    assert f"Replay of periodic, event, at {at:g} s" in still
    assert "<text" not in still  # no letters that a reader's machine may not have
    assert len(still) < 3e5
    assert replay.embedded([]) == ""
    figure, show = trajectories.film(traces)
    show(at)
    for axes, trace in zip(figure.axes, traces, strict=True):
        last = int(np.searchsorted(trace.time, at + 1e-9)) - 1
        dots = [line.get_data_3d() for line in axes.lines if line.get_marker() == "o"]
        drawn = np.hstack(dots).T
        assert drawn == pytest.approx(trace.true_position[last])


@needs_chromium
@pytest.mark.system
def test_slider_moves_robots_and_still_picture_is_printed(traces, tmp_path):
    api = pytest.importorskip("playwright.sync_api")
    file = tmp_path / "page.html"
    file.write_text(f"<!doctype html><meta charset=utf-8>{replay.embedded(traces)}", "utf-8")
    with api.sync_playwright() as driver:
        browser = driver.chromium.launch(executable_path=CHROMIUM, args=["--no-sandbox", "--disable-gpu"])
        page, faults, asked = browser.new_page(), [], []
        page.on("pageerror", lambda error: faults.append(str(error)))
        page.on("request", lambda request: asked.append(request.url))
        page.goto(file.as_uri())
        page.locator("#film input").fill("2")
        places = page.evaluate("document.getElementById('film').replay.places()")
        shown = [page.locator(part).is_visible() for part in ("#film", ".still svg")]
        page.emulate_media(media="print")
        printed = [page.locator(part).is_visible() for part in ("#film", ".still svg")]
        plain = browser.new_context(java_script_enabled=False).new_page()
        plain.goto(file.as_uri())
        unscripted = [plain.locator(part).is_visible() for part in ("#film", ".still svg")]
        browser.close()
    assert (shown, printed, unscripted) == ([True, False], [False, True], [False, True])
    assert (faults, asked) == ([], [file.as_uri()])
    for trace, robots in zip(traces, places, strict=True):
        at = int(np.argmin(np.abs(trace.time - 2.0)))
        assert np.array(robots)[:, :3] == pytest.approx(trace.true_position[at], abs=1e-3)
