from __future__ import annotations

import dataclasses
import itertools
import json
import re

import msgspec
import numpy as np
import pytest
from matplotlib.backends.backend_agg import FigureCanvasAgg

from experiments.definition.experiment import Arena
from experiments.metrics.measure import measure
from experiments.report import figures, replay, style, trajectories
from tests.cases import nightly
from tests.experiments.traces import crowd, cut, pair, park
from tests.runs import flown
from tests.system.browser import CHROMIUM, needs_chromium

pytestmark = pytest.mark.slow  # runs and reports, whole

WITHOUT_SPACE = ["errors", "robot_bars", "events", "intervals"]


def thick(axes):
    """Curves of whole cases."""
    return [line for line in axes.lines if line.get_linewidth() == 1.3]


@pytest.fixture(scope="module")
def two_cases():
    return [park(), park("event", 0.01)]


@pytest.mark.parametrize("few", [True, pytest.param(False, marks=pytest.mark.nightly)])
def test_figures_fit_in_one_column(few, two_cases):
    traces = two_cases if few else [crowd(40, f"case{k}", 0.01 * k, duration=2.0) for k in range(5)]
    for draw in (trajectories.formation, figures.errors, figures.events, figures.intervals, trajectories.plan_view):
        figure = draw(traces)
        assert (figure.get_figwidth(), draw(traces, width=7.16).get_figwidth()) == (3.5, 7.16)
        assert 1.0 < figure.get_figheight() <= 9.3
        assert len(figure.axes) >= (len(traces) if draw is figures.events else 1)
        assert "<metadata" not in style.svg(figure)
    for draw in (figures.global_bars, figures.robot_bars):
        figure = draw([measure(trace) for trace in traces])
        assert figure.get_figwidth() == 3.5
        canvas = FigureCanvasAgg(figure)
        canvas.draw()
        renderer = canvas.get_renderer()
        for legend in figure.legends:
            box = legend.get_window_extent(renderer)
            assert 0.0 <= box.x0 < box.x1 <= figure.bbox.x1
        for axes in figure.axes:
            boxes = [label.get_window_extent(renderer) for label in axes.get_xticklabels() if label.get_text()]
            assert not any(a.x1 > b.x0 for a, b in itertools.pairwise(boxes))


def test_many_cases_with_long_names_fit_a_page():
    """Legends have few entries and lie above the curves; labels of axes lie on the page; the rest is counted."""
    few = [park(*case, duration=2.0) for case in (("periodic",), ("event", 0.01))]
    names = [f"send_on_delta_with_threshold_{k:02d}_millimetres_and_hold" for k in range(18)]
    traces = [dataclasses.replace(few[k % 2], case=name) for k, name in enumerate(names)]
    known = [measure(trace) for trace in few]
    cases = [msgspec.structs.replace(known[k % 2], case=name) for k, name in enumerate(names)]
    words = {}
    for name, figure in figures.all_figures(cases, traces).items():
        assert figure.get_figheight() <= style.TALLEST, name
        canvas = FigureCanvasAgg(figure)
        canvas.draw()
        renderer = canvas.get_renderer()
        for axes in figure.axes:
            assert name == "formation" or not axes.get_visible() or axes.get_position().height > 0.02
            label = axes.yaxis.label.get_window_extent(renderer)
            assert label.y0 >= -1.0, name
            assert label.y1 <= figure.bbox.y1 + 1.0
        for legend in figure.legends:
            box = legend.get_window_extent(renderer)
            assert 0.0 <= box.x0 < box.x1 <= figure.bbox.x1 + 1.0
            assert (
                all(box.y0 > axes.get_window_extent(renderer).y1 - 1.0 for axes in figure.axes) or name == "formation"
            )
            words[name] = [text.get_text() for text in legend.get_texts()]
            assert len(words[name]) <= 16
        words.setdefault(name, []).append(figure.get_supxlabel())
    assert ("and 4 more" in words["errors"], words["errors"][-2]) == (True, "within 5 cm")
    assert {name for name, texts in words.items() if "more cases" in texts[-1]} == {"plan_view", "events"}


def test_global_bars_are_ratios_to_the_first_case(two_cases):
    cases = [measure(each) for each in two_cases]
    rate, errors = figures.global_bars(cases).axes
    heights = [bar.get_height() for axes in (rate, errors) for bar in axes.patches]
    expected = [cases[1].mean[index] / cases[0].mean[index] for index in ("f_hz", "iae", "itae", "rmse")]
    assert heights == pytest.approx(expected)  # without bars of the first case, which are 1
    assert rate.get_ylim()[1] < 1.5 * heights[0]  # a small rate is seen in an axis of its own


def test_plan_shows_surroundings_with_few_cases_overlaid():
    traces = [park(f"case {k}", duration=3.0) for k in range(4)]
    hall = traces[0].plan.changed(arena=Arena(size=(30.0, 30.0, 3.0)))
    wide = [dataclasses.replace(trace, plan=hall) for trace in traces]
    (axes,) = trajectories.plan_view(wide[:3]).axes
    for limits, k in ((axes.get_xlim(), 0), (axes.get_ylim(), 1)):
        place = traces[0].true_position[..., k]
        assert np.ptp(limits) == pytest.approx(1.12 * np.ptp(place))
        assert limits[0] < place.min() < place.max() < limits[1]
    assert [text.get_text() for text in axes.texts] == list(traces[0].robots)
    paths = [line for line in axes.lines if len(line.get_xdata()) > 2]
    assert len({(line.get_color(), line.get_linewidth()) for line in paths}) == 3
    assert len(trajectories.plan_view(wide).axes) == 4
    equal = Arena(), Arena(size=(*Arena().size[:2], 2.5))  # its size spelled out
    plain, spelled = (dataclasses.replace(wide[0], plan=hall.changed(arena=arena)) for arena in equal)
    assert len(trajectories.plan_view([plain, spelled]).axes) == 1


def test_seeds_become_one_bar_or_a_band():
    traces = [park(*case, seed=seed, duration=5.0) for case in (("a",), ("b", 0.01)) for seed in (1, 2, 3)]
    cases = [measure(each) for each in traces]
    axes = figures.global_bars(cases).axes[1]
    ratio = [b.mean["iae"] / a.mean["iae"] for a, b in zip(cases[:3], cases[3:], strict=True)]
    assert axes.patches[0].get_height() == pytest.approx(np.mean(ratio))
    half = 4.302653 * np.std(ratio, ddof=1) / np.sqrt(3.0)
    assert np.ptp(axes.collections[-1].get_segments()[0][:, 1]) == pytest.approx(2.0 * half, rel=1e-4)
    (axes,) = figures.errors(traces[:3]).axes
    assert (len(thick(axes)), len(axes.collections)) == (1, 1)
    assert not [line for line in axes.lines if line.get_linewidth() == 0.4], "curves of single robots"


def test_errors_of_cases_share_a_marked_logarithmic_axis(two_cases):
    """Tolerance and acquisition are marked on it."""
    cases = [measure(each) for each in two_cases]
    (axes,) = figures.errors(two_cases, cases).axes
    assert (axes.get_yscale(), axes.get_xlim()) == ("log", (0.0, 45.0))
    assert max(len(line.get_xdata()) for line in axes.lines) <= 1500
    marks = [line for line in axes.lines if line.get_marker() == "v"]
    for case, line, mark in zip(cases, thick(axes), marks, strict=True):
        acquired = [start + at for start, at in zip(case.starts_s, case.acquired_s, strict=True)]
        assert list(mark.get_xdata()) == pytest.approx(acquired)
        assert set(mark.get_ydata()) == {case.tolerance}
        time, worst = line.get_data()
        first = (time > acquired[0] + 0.1) & (time < case.starts_s[1])
        assert (worst[first] <= case.tolerance).all()  # what is drawn is what acquisition is judged by
        assert worst[time < acquired[0] - 0.1][-1] > case.tolerance
    (axes,) = figures.errors([pair(1.0 + np.exp(-np.arange(0.0, 9.0, 0.02)))]).axes  # down to 0.2 mm
    assert axes.get_ylim()[0] <= np.nanmin(thick(axes)[0].get_ydata()) < 3e-4


def test_transmissions_and_their_intervals_are_drawn():
    def sending(leader, follower):
        return pair(np.zeros(1001), sent={"L": leader, "F": follower})

    known = sending([1.0, 2.0, 2.01, 5.0], [])
    outline = figures.events([known]).axes[0].patches[0].get_path()
    assert len(outline.vertices) == 3 * 5  # 2.00 and 2.01 touch in print
    assert outline.vertices[:, 0].min() == pytest.approx(1.0)
    text, raster = figures.events([park(), park("event", 0.05)]).axes
    assert text.get_title(loc="left") == "periodic: every robot throughout, 50 Hz"
    assert (len(text.patches), len(raster.patches)) == (0, 7)
    x, y = figures.intervals([sending([1.0], [0.0, 0.5, 1.0, 3.0])]).axes[0].lines[0].get_data()
    assert (x[0], x[-1], y[0], y[-1]) == pytest.approx((0.5, 2.0, 0.0, 1.0))
    assert y[np.searchsorted(x, 0.5, side="right") - 1] == pytest.approx(2.0 / 3.0)


def test_every_figure_and_motions_of_the_first_seed():
    traces = [park("a", seed=seed, duration=22.0) for seed in (2, 1)]
    made = figures.all_figures([measure(each) for each in traces], traces)
    assert list(made) == ["plan_view", "formation", *WITHOUT_SPACE]
    line = made["plan_view"].axes[0].lines[-2].get_xdata()
    assert line[0] == traces[0].true_position[-1, -1, 0]
    links = np.array(made["formation"].axes[0].collections[0]._segments3d)
    assert links.shape == (12, 2, 3)
    assert np.isin(links.reshape(-1, 3), traces[0].true_position[-1]).all()
    small = crowd(3, duration=1.0)
    flat = dataclasses.replace(small, true_position=small.true_position * [1.0, 1.0, 0.0])
    assert "formation" not in figures.all_figures([], [flat])


def drawn(traces, *, rendered=True):
    """Names of all figures, each rendered."""
    made = figures.all_figures([measure(each) for each in traces if len(each.time) > 1], traces)
    assert not rendered or all("<svg" in style.svg(figure) for figure in made.values())
    return list(made)


def unknown(known, rows=np.s_[:]):
    place = known.true_position.copy()
    place[rows] = np.nan
    return dataclasses.replace(known, true_position=place, position=place)


def test_short_and_unknown_cases_are_drawn():
    assert drawn([cut(park(), 8.0)], rendered=False) == ["plan_view", "formation", *WITHOUT_SPACE]
    names = drawn([park("a", duration=23.0), unknown(park("b", duration=23.0))])
    assert {"formation", "global_bars"} <= set(names)
    for samples in (2, 1):
        known = cut(park(), 0.02 * (samples - 1))
        assert len(known.time) == samples
        assert "plan_view" in drawn([known])
        assert drawn([unknown(known)]) == [name for name in WITHOUT_SPACE if samples > 1 or name != "robot_bars"]
    assert figures.all_figures([], []) == figures.all_figures([], [cut(park(), -1.0)]) == {}


@pytest.mark.parametrize("rows", [np.s_[300:], nightly(np.s_[:1100]), nightly(np.s_[50:, 6]), np.s_[:, 5]])
def test_whatever_is_unknown_can_be_drawn(rows):
    known = park(duration=23.0)
    silent = dataclasses.replace(known, sent=known.sent.take(np.arange(0)))
    assert "plan_view" in drawn([unknown(silent if isinstance(rows, tuple) else known, rows)])


def test_saved_files_are_reproducible_vectors_with_real_fonts(tmp_path):
    page, drawing, known = tmp_path / "intervals.pdf", tmp_path / "intervals.svg", [park(duration=3.0)]
    text = style.save(figures.intervals(known), tmp_path, "intervals")
    assert text == drawing.read_text() == style.svg(figures.intervals(known))
    assert "<text" not in text
    names = {f"http://www.w3.org/{name}" for name in ("2000/svg", "1999/xlink")}
    assert set(re.findall(r"https?://[^\"]*", text.split("<svg")[1])) <= names
    assert not page.exists()
    style.save(figures.intervals(known), tmp_path, "intervals", pdf=True)
    content = page.read_bytes()
    assert [content.find(part) for part in (b"%PDF", b"/Type3", b"/CreationDate")] == [0, -1, -1]
    style.save(figures.intervals(known, 7.16), tmp_path, "intervals")
    assert page.read_bytes() != content, "a file that is there is kept current"


@pytest.fixture(scope="module")
def traces():
    return [flown("robotic-park", case, "duration_s=3.0", "timeline=[]").trace for case in ("periodic", "event")]


def test_replay_moves_robots_to_where_they_were(traces):
    """It stands alone, to a millimetre."""
    page = replay.embedded(traces)
    assert ("http" in page, page.count("</script>"), replay.embedded([])) == (False, 1, "")
    film = json.loads(re.search(r'getElementById\("film"\), (\{.*\})\);', page)[1])
    assert [case["name"] for case in film["cases"]] == ["periodic", "event"]
    assert film["names"] == list(traces[0].robots)
    assert len(page) < 3e6
    for trace, case in zip(traces, film["cases"], strict=True):
        for k, sample in enumerate(case["p"]):
            at = int(np.argmin(np.abs(trace.time - k * case["step"])))
            assert np.array(sample).reshape(-1, 4)[:, :3] / 1e3 == pytest.approx(trace.true_position[at], abs=1e-3)


def test_film_shows_robots_where_they_were(traces):
    figure, show = trajectories.film(traces)
    show(1.8)
    for axes, trace in zip(figure.axes, traces, strict=True):
        last = int(np.searchsorted(trace.time, 1.8 + 1e-9)) - 1
        dots = [line.get_data_3d() for line in axes.lines if line.get_marker() == "o"]
        np.testing.assert_allclose(np.hstack(dots).T, trace.true_position[last])


@needs_chromium
@pytest.mark.system
def test_slider_moves_robots_and_replay_is_printed(traces, tmp_path):
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
        plain, seen = browser.new_context(java_script_enabled=False).new_page(), []
        plain.goto(file.as_uri())
        for shown, media in ((page, "screen"), (page, "print"), (plain, "screen")):
            shown.emulate_media(media=media)
            seen.append([shown.locator(part).is_visible() for part in ("canvas", ".bar", "noscript p")])
        browser.close()
    assert (seen, faults, asked) == (
        [[True, True, False], [True, False, False], [False, False, True]],
        [],
        [file.as_uri()],
    )
    for trace, robots in zip(traces, places, strict=True):
        at = int(np.argmin(np.abs(trace.time - 2.0)))
        assert np.array(robots)[:, :3] == pytest.approx(trace.true_position[at], abs=1e-3)
