from __future__ import annotations

import dataclasses
import itertools
import re

import numpy as np
import pytest
from matplotlib.backends.backend_agg import FigureCanvasAgg

from experiments.metrics.measure import measure
from experiments.metrics.signals import formation_errors
from experiments.report import figures
from tests.experiments.traces import crowd, cut, experiment, park, trace

pytestmark = pytest.mark.slow  # runs and reports, whole

OF_TRACES = (
    figures.formation_before,
    figures.formation_after,
    figures.errors,
    figures.events,
    figures.intervals,
    figures.plan_view,
)
OF_CASES = (figures.global_bars, figures.robot_bars)
RUNS = {
    "7 robots, 2 cases, a leg": lambda: [park(duration=23.0), park("event", 0.01, duration=23.0)],
    "3 robots, 1 case": lambda: [crowd(3, duration=3.0)],
    "40 robots, 5 cases": lambda: [crowd(40, f"case{k}", 0.01 * k, duration=2.0) for k in range(5)],
}


LARGE = "40 robots, 5 cases"
EVERY = [pytest.param(name, marks=pytest.mark.slow if name == LARGE else ()) for name in RUNS]


@pytest.fixture(scope="module", params=EVERY)
def run(request):
    return RUNS[request.param]()


@pytest.mark.parametrize("draw", OF_TRACES, ids=lambda draw: draw.__name__)
def test_motions_are_drawn_in_one_column(draw, run):
    figure = draw(run)
    assert figure.get_figwidth() == 3.5
    assert 1.0 < figure.get_figheight() <= 9.3
    assert len(figure.axes) >= (1 if draw is figures.intervals else len(run))
    assert "<metadata" not in figures.svg(figure)


@pytest.mark.parametrize("draw", OF_CASES, ids=lambda draw: draw.__name__)
def test_bars_are_drawn_in_one_column(draw, run):
    figure = draw([measure(trace) for trace in run])
    assert figure.get_figwidth() == 3.5
    canvas = FigureCanvasAgg(figure)
    canvas.draw()
    renderer = canvas.get_renderer()
    for axes in figure.axes:
        boxes = [label.get_window_extent(renderer) for label in axes.get_xticklabels() if label.get_text()]
        assert not any(a.x1 > b.x0 for a, b in itertools.pairwise(boxes))


def test_global_bars_are_ratios_to_the_first_case():
    cases = [measure(park()), measure(park("event", 0.01))]
    heights = [bar.get_height() for bar in figures.global_bars(cases).axes[0].patches]
    assert heights[:4] == [1.0] * 4
    expected = [cases[1].mean[index] / cases[0].mean[index] for index in ("f_hz", "iae", "itae", "rmse")]
    assert heights[4:] == pytest.approx(expected)


def test_several_seeds_become_one_bar_with_its_interval():
    cases = [measure(park("a", seed=seed, duration=5.0)) for seed in (1, 2, 3)]
    cases += [measure(park("b", 0.01, seed=seed, duration=5.0)) for seed in (1, 2, 3)]
    axes = figures.global_bars(cases).axes[0]
    ratio = [b.mean["iae"] / a.mean["iae"] for a, b in zip(cases[:3], cases[3:], strict=True)]
    assert axes.patches[5].get_height() == pytest.approx(np.mean(ratio))
    segments = axes.collections[-1].get_segments()
    half = 4.302653 * np.std(ratio, ddof=1) / np.sqrt(3.0)
    assert np.ptp(segments[1][:, 1]) == pytest.approx(2.0 * half, rel=1e-4)


def test_errors_show_every_robot_and_the_leg():
    known = park()
    axes = figures.errors([known]).axes[0]
    curves = {len(line.get_xdata()): line for line in axes.lines}
    assert list(axes.lines[-1].get_xdata()) == [21.0, 21.0]
    assert len(axes.lines) == 8
    assert max(curves) <= 1500
    assert max(np.max(line.get_ydata()) for line in axes.lines[:-1]) == pytest.approx(formation_errors(known).max())
    assert axes.get_xlim() == (0.0, 45.0)


def test_raster_has_one_box_per_separate_transmission():
    what = experiment({"L": "turtlebot3", "F": "khepera4"}, {"L > F": 1.0})
    known = trace(what, np.zeros((1001, 2, 3)), sent={"L": [1.0, 2.0, 2.01, 5.0], "F": []})
    outline = figures.events([known]).axes[0].patches[0].get_path()
    assert len(outline.vertices) == 3 * 5  # 2.00 and 2.01 touch in print
    assert outline.vertices[:, 0].min() == pytest.approx(1.0)


def test_intervals_reach_one_at_the_longest():
    what = experiment({"L": "turtlebot3", "F": "khepera4"}, {"L > F": 1.0})
    known = trace(what, np.zeros((1001, 2, 3)), sent={"L": [1.0], "F": [0.0, 0.5, 1.0, 3.0]})
    x, y = figures.intervals([known]).axes[0].lines[0].get_data()
    assert (x[0], x[-1], y[0], y[-1]) == pytest.approx((0.5, 2.0, 0.0, 1.0))
    assert y[np.searchsorted(x, 0.5, side="right") - 1] == pytest.approx(2.0 / 3.0)


def test_every_figure_of_the_first_seed():
    traces = [park("a", seed=seed, duration=22.0) for seed in (2, 1)]
    drawn = figures.every([measure(each) for each in traces], traces)
    names = ["global_bars", "formation_before", "formation_after", "robot_bars", "errors", "events", "intervals"]
    assert list(drawn) == [*names, "plan_view"]
    line = drawn["errors"].axes[0].lines[1].get_ydata()
    assert line[0] == formation_errors(traces[0])[0, 1]
    assert len(drawn["errors"].axes) == 1
    small = crowd(3, duration=1.0)
    assert "formation_after" not in figures.every([measure(small)], [small])


def test_links_go_from_black_to_magenta():
    known = park()
    axes = figures.formation_before([known]).axes[0]
    start, end = axes.collections
    first, last = (np.array(each._segments3d) for each in (start, end))
    before = np.searchsorted(known.time, 21.0 - 1e-9) - 1
    assert first.shape == last.shape == (12, 2, 3)
    assert np.isin(last.reshape(-1, 3), known.true_position[before]).all()
    assert np.isin(first.reshape(-1, 3), known.true_position[0]).all()


@pytest.mark.parametrize("draw", OF_TRACES, ids=lambda draw: draw.__name__)
def test_a_robot_that_died_or_never_spoke_can_be_drawn(draw):
    known = park(duration=3.0)
    place = known.true_position.copy()
    place[50:, 6] = np.nan
    place[:, 5] = np.nan
    silent = known.sent.take(np.arange(0))
    assert "<svg" in figures.svg(draw([dataclasses.replace(known, true_position=place, sent=silent)]))


def drawn(traces):
    """All figures, rendered."""
    measured = [measure(each) for each in traces if len(each.time) > 1]
    made = figures.every(measured, traces)
    for figure in made.values():
        assert "<svg" in figures.svg(figure)
    return list(made)


def unknown(known, rows):
    place = known.true_position.copy()
    place[rows] = np.nan
    return dataclasses.replace(known, true_position=place, position=place)


WITHOUT_SPACE = ["global_bars", "robot_bars", "errors", "events", "intervals"]


def test_no_trace_gives_no_figure():
    assert figures.every([], []) == {}


def test_a_trace_that_ends_before_the_first_leg():
    known = cut(park(), 8.0)
    assert drawn([known]) == [*WITHOUT_SPACE[:1], "formation_before", *WITHOUT_SPACE[1:], "plan_view"]


def test_a_robot_less_span_is_left_out():
    names = drawn([unknown(park(duration=23.0), np.s_[300:])])
    assert "formation_before" in names
    assert "formation_after" not in names
    names = drawn([unknown(park(duration=23.0), np.s_[:1100])])
    assert "formation_before" not in names
    assert "formation_after" in names


def test_one_case_of_two_that_is_unknown_after_the_leg():
    names = drawn([park("a", duration=23.0), unknown(park("b", duration=23.0), np.s_[300:])])
    assert "formation_after" in names


@pytest.mark.parametrize("samples", [2, 1])
def test_nothing_known_and_hardly_any_time(samples):
    known = cut(park(), 0.02 * (samples - 1))
    assert len(known.time) == samples
    assert "plan_view" in drawn([known])
    assert drawn([unknown(known, np.s_[:])]) == (WITHOUT_SPACE if samples > 1 else WITHOUT_SPACE[2:])


def test_no_sample_gives_no_picture():
    known = cut(park(), -1.0)
    assert figures.every([], [known]) == {}


@pytest.mark.parametrize("draw", OF_TRACES, ids=lambda draw: draw.__name__)
def test_whatever_is_unknown_can_be_drawn(draw):
    known = park(duration=23.0)
    for rows in (np.s_[:], np.s_[300:], np.s_[:1100], np.s_[1:]):
        assert "<svg" in figures.svg(draw([unknown(known, rows)]))


def test_saved_files_are_vector_with_real_fonts_and_the_same_every_time(tmp_path):
    figure = figures.intervals([park(duration=3.0)])
    drawing, page = figures.save(figure, tmp_path / "figures", "intervals")
    assert drawing.read_text() == figures.svg(figures.intervals([park(duration=3.0)]))
    assert "<text" not in drawing.read_text()
    assert set(re.findall(r"https?://[^\"]*", drawing.read_text().split("<svg")[1])) <= {
        "http://www.w3.org/2000/svg",
        "http://www.w3.org/1999/xlink",
    }
    content = page.read_bytes()
    assert content.startswith(b"%PDF")
    assert b"/Type3" not in content
    assert b"/CreationDate" not in content
