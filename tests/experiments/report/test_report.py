from __future__ import annotations

import csv
import dataclasses
import re
from html.parser import HTMLParser

import msgspec
import numpy as np
import pytest

from agents.network.messages import Contact, Event, WorldState
from experiments.definition.experiment import Arena, Shadow, Start
from experiments.metrics.measure import measure
from experiments.metrics.statistics import Spread, spread
from experiments.recording.run_folder import RunOrigin
from experiments.report import report
from experiments.report.metrics_files import write_csv
from experiments.report.page import date_of, interval, number
from experiments.report.tables import events_tables, proof_tables, robot_tables, summary_table, whole_tables
from experiments.report.verdict import findings, left_out
from tests.experiments.traces import at_origin, crowd, cut, park, trace

pytestmark = pytest.mark.slow  # runs and reports, whole

VOID = {"meta", "link", "br", "hr", "img", "input"}


class Page(HTMLParser):
    """Checks that elements close, and collects ids, references and text."""

    def __init__(self, html):
        super().__init__()
        self.open, self.ids, self.text, self.wanted = [], [], [], set()
        self.feed(html)
        self.close()
        self.words = re.sub(r"[ \n]+", " ", " ".join(self.text))

    def handle_starttag(self, tag, attrs):
        if tag not in VOID:
            self.open.append(tag)
        self.handle_startendtag(tag, attrs)

    def handle_startendtag(self, tag, attrs):
        assert tag not in {"iframe", "img", "link", "object"}
        for name, value in attrs:
            assert not name.startswith("on")
            self.wanted |= set(re.findall(r"url\(#([^)]*)\)", value or ""))
            if name in {"href", "xlink:href", "src", "aria-labelledby"}:
                self.wanted.add(value.removeprefix("#"))
            elif name == "id":
                self.ids.append(value)

    def handle_endtag(self, tag):
        assert self.open.pop() == tag

    def handle_data(self, data):
        self.text.append(data)


def checked_page(file):
    html = file.read_text("utf-8")
    page = Page(html)
    assert (page.open, len(page.ids)) == ([], len(set(page.ids)))
    assert page.wanted <= set(page.ids)
    assert html.count("<script") <= 1, "that of the replay"
    assert not re.findall(r"https?://", re.sub(r'xmlns(:\w+)?="[^"]*"', "", html))
    return page


def page_of(folder, *traces, **more):
    return checked_page(report.write(folder, traces, **more))


def measured(traces):
    return [measure(trace) for trace in traces]


def marks_of(*traces):
    """Marks of the verdict, by text."""
    return {finding.text: finding.mark for finding in findings(measured(traces))}


@pytest.fixture(scope="module")
def two_cases():
    return [park(), park("event", 0.01)]


def test_report_of_a_run_stands_alone(tmp_path, two_cases):
    def write():
        return report.write(tmp_path / "new" / "run", two_cases, run=tmp_path, notes=["It rained."])

    (tmp_path / "run.json").write_bytes(msgspec.json.encode(RunOrigin("zenpark run <this> --seed 1", "2030-01-02")))
    html = write().read_text("utf-8")
    page = checked_page(again := write())
    assert again.read_text("utf-8") == html
    assert page.ids.count("f1-figure_1") == page.ids.count("f7-figure_1") == 1
    for words in (
        "Nobody, Nowhere 2020", "2030-01-02", "It rained.", "zenpark run <this> --seed 1", "No pose was lost: 17\u202f",
        "TB01 leads and is left out of the means.", "Figure 7.", "all robots are ready", "ITAE",
    ):  # fmt: skip
        assert words in page.words
    assert len(html.encode()) < 1_500_000
    links = re.findall(r'href="#([^"]*)"', html[html.index("<nav") : html.index("</nav>")])
    folded = {anchor for anchor in links if f'<div id="{anchor}">' in html}
    assert [each for each in links if each not in folded] == ["verdict", "replay", "results", "figures", "events"]
    assert {"each-robot", "data-integrity", "experiment-file", "definitions"} <= folded


def test_telling_events_stand_open_and_once():
    leg, late = (Event(at, "phase", "conductor", "leader under way") for at in (5.0, 7.0))
    first = dataclasses.replace(crowd(3, "a", duration=1.0), events=(Event(0.0, "robot", "A", "running"), leg))
    again = msgspec.structs.replace(leg, stamp=5.1)
    short, every = events_tables([first, dataclasses.replace(first, case="b", events=(again, late))])
    assert [row.cells[:3] for row in short.rows] == [("all", "5.00", "phase"), ("b", "7.00", "phase")]
    assert every[0] == "All 3 events"
    assert events_tables([dataclasses.replace(first, events=(leg,))])[1] is None


def test_page_of_one_case_keeps_markup_as_text(tmp_path):
    bad = '<script>alert("1")</script> & {{ 7 * 7 }} $\\frac$'
    what = dataclasses.replace(crowd(3, duration=2.0), events=(Event(1.0, bad, bad, bad),) * 250, case=bad)
    words = page_of(tmp_path, what, date=bad, text="[file]\nx = '<b>'").words
    assert words.count(bad) > 5
    for text in ("x = '<b>'", "50 more are in the recording.", "Figure 6."):
        assert text in words
    assert "Figure 7." not in words, "ratios to the first case"


def test_report_over_seeds_gives_intervals(tmp_path):
    runs = [park(name, size, seed=seed, duration=8.0) for name, size in (("a", 0.0), ("b", 0.02)) for seed in (1, 2, 3)]
    words = page_of(tmp_path, *runs).words
    for text in ("Whiskers: 95 % confidence over 3 seeds.", "1 to 3", "All seeds begin at the same poses"):
        assert text in words
    cells = summary_table(measured(runs)).rows[3].cells
    assert re.fullmatch(r"\d\.\d+ ± 0\.\d+, × \d\.\d+ ± 0\.\d+", f"{cells[1]}, {cells[2][1]}")
    scattered = runs[0].plan.changed(start=Start(scatter=0.1))
    apart = [dataclasses.replace(each, plan=scattered) for each in runs]
    assert "begin at the same poses" not in page_of(tmp_path / "b", *apart, drawn=False).words


def test_comparison_has_a_column_per_run_and_case(tmp_path, two_cases):
    runs = [("a", measured(cases)) for cases in (two_cases[:1], two_cases[:1], two_cases)]
    shown = ("a, a (2), a (3)", "relative to a.", "a (3) · event")
    differ = [("A", "runs/a", []), ("B", "runs/b", ["duration_s 45 → 44", "seeds: 1 → 2", "x 1 → 2"])]
    words = checked_page(report.compare(tmp_path / "there" / "compare.html", runs, differences=differ)).words
    differences = (
        "! B differs in duration_s 45 → 44; seeds: 1 → 2 and 1 more.",
        "A runs/a the reference B runs/b duration_s 45 → 44; seeds: 1 → 2; x 1 → 2",
    )
    for text in (*shown, *differences):
        assert text in words
    for absent in ("±", "95 % confidence over", "Seeds"):
        assert absent not in words.split("Definitions")[0]


def test_one_of_two_cases_interrupted(tmp_path):
    traces = park("a"), cut(park("b", 0.01), 10.0)
    page = page_of(tmp_path, *traces, drawn=False).words
    assert "b was interrupted after 10.0 s of 45 s" in page.split("In short")[2]
    said = "\n".join(marks_of(*traces))
    assert said.startswith("b was interrupted after 10.0 s of 45 s: all its figures are up to there.\n")
    again = "\nIn the phase from 21 s on it was acquired by all again after"
    known = ("\nRuns of different length of b and a are not compared.\n", again, "never")
    assert [part in said for part in known] == [True, True, False]
    said = marks_of(cut(park(), 1.0))
    assert said["The formation was not within 5 cm when periodic was interrupted."] == "plain"
    assert "bad" not in said.values()


def test_a_report_made_again_keeps_date_and_command(tmp_path):
    known = crowd(3, duration=2.0)
    (tmp_path / "run.json").write_bytes(msgspec.json.encode(RunOrigin("zenpark run x.toml", "2031-02-03")))
    words = page_of(tmp_path / "new", known, run=tmp_path, date="2032-01-01", drawn=False).words
    assert [part in words for part in ("zenpark run x.toml", "2031-02-03", "2032")] == [True, True, False]
    assert not (tmp_path / "new" / "run.json").exists()
    other = tmp_path / "case" / "run.json"
    other.parent.mkdir()
    other.write_text('{"title": "the case named run"}')  # another file of that name is left alone
    words = page_of(other.parent, known, date=date_of(1.76e9), drawn=False).words
    shown = [part in words for part in ("2025-10-09 08:53 UTC", '"duration_s": 2.0', "Reproduce")]
    assert shown == [True, True, False], "the experiment is shown even without its file"
    assert other.read_text() == '{"title": "the case named run"}'


def test_nothing_to_report():
    with pytest.raises(ValueError, match="no case"):
        report.write("x", [])
    with pytest.raises(ValueError, match="no run"):
        report.compare("x", [("a", [])])


def test_verdict_says_what_was_measured(two_cases):
    periodic, event = cases = measured(two_cases)
    said = marks_of(*two_cases)
    fewer = 100.0 * (1.0 - event.mean["f_hz"] / periodic.mean["f_hz"])
    sent, again = (sum(robot.f_hz for robot in case.robots) for case in cases)  # the means leave the leader out
    first, after = periodic.acquired_s
    for words in (
        rf"event needs {fewer:.1f} % fewer transmissions than periodic: f 4\..*"
        rf" Hz; leaders included, {100.0 * (1.0 - again / sent):.1f} % fewer\.$",
        rf".*acquired by all to 5 cm after {first:.2f} s \(periodic\)",
        rf".*In the phase from 21 s on it was acquired by all again after {after:.2f} s \(periodic\)",
        r"No robot touched .* cm between robots \(\w+–\w+ at [\d.]+ s, \w+\) and [\d.]+ cm between robot and arena ",
    ):
        assert any(re.match(words, text) for text in said), words
    ratio = event.mean["iae"] / periodic.mean["iae"]
    assert [mark for text, mark in said.items() if f"IAE {ratio:.3f}" in text] == ["plain"]
    same = findings([periodic, msgspec.structs.replace(periodic, case="again")])
    as_many = "again needs as many transmissions as periodic: "
    assert [each.mark for each in same if each.text.startswith(as_many)] == ["plain"]


def side_by_side(*, apart=0.5, target=None, seed=1):
    """Two Kheperas that stand for two seconds, in an arena of 4 m without walls."""
    arena = Arena(size=(4.0, 4.0, 2.5), walls=False)
    what = at_origin({"A": "khepera4", "B": "khepera4"}, {"A - B": target or apart}, arena=arena)
    place = np.zeros((101, 2, 3))
    place[:, 1, 0] = apart
    return trace(what, place, seed=seed)


def test_verdict_names_what_went_wrong():
    text = "No robot touched another or the arena; the closest approach was 36.0 cm between robots (A–B at 0.0 s)."
    assert marks_of(side_by_side())[text] == "good"
    astray = side_by_side(apart=2.1, target=1.0)
    assert marks_of(astray)["The formation never stayed within 5 cm in only."] == "bad"
    assert marks_of(astray)["B was 10.0 cm outside the arena in only."] == "bad"
    contacts = tuple(Contact(0.5 * k, "A", "wall" if k else "B", 0.012 * k, 0.0003) for k in range(5))
    marks = marks_of(dataclasses.replace(side_by_side(), contacts=contacts))
    (text,) = [text for text in marks if text.startswith("5 collisions in only: A–B at 0.00 s (0 mN s, 0.0300 cm")]
    assert text.endswith("A–wall at 1.00 s (24.0 mN s, 0.0300 cm deep) and 2 more.")
    assert marks[text] == "bad"
    seeds = [side_by_side(), side_by_side(apart=0.1, seed=2)]
    assert marks_of(*seeds)["One collision in 1 of 2 seeds of only: A–B at 0.00 s (4.00 cm deep)."] == "bad"


def test_verdict_on_a_world_that_fell_behind():
    def paced(*factors, clock="real"):
        states = [WorldState(float(k), "pymunk", 0.0, each, 0.1, each == 0.0, []) for k, each in enumerate(factors)]
        return dataclasses.replace(side_by_side(), world=tuple(states), clock=clock)

    text = "The world fell behind: at its slowest it ran at 0.93 of real time, in only."
    assert marks_of(paced(1.0, 0.93, 0.0))[text] == "fair"  # it was paused in the end
    assert marks_of(paced(1.0, 0.5))[text.replace("0.93", "0.50")] == "bad"
    for kept_up in (paced(1.0, 0.995), paced(0.5, clock="virtual")):
        assert "world" not in " ".join(marks_of(kept_up))


@pytest.fixture
def shadowed():
    """Two robots with twins beside them, a contact, and ticks on which avoidance was at work."""
    plain = side_by_side()
    given = plain.plan.experiment.robots
    robots = {name: msgspec.structs.replace(robot, shadow=Shadow()) for name, robot in given.items()}
    return dataclasses.replace(
        plain,
        plan=plain.plan.changed(robots=robots),
        contacts=(Contact(1.234, "A", "B", 0.017, 0.0004),),
        interventions=np.array([10, 40]),
        avoided=np.array([0, 25]),
        ticks=np.array([100, 100]),
        shadow_position=plain.position + np.array([0.0, 0.012, 0.0]),
        shadow_yaw=plain.yaw,
    )


def test_report_shows_avoidance_and_shadow_twins(tmp_path, shadowed):
    said = marks_of(shadowed)
    assert said["Avoidance was at work on 12.5 % of all ticks in only, most on those of B (25)."] == "plain"
    foreseen = "to 1.20 cm RMSE up to 5 s ahead (only)"
    assert f"Twins beside robots foresaw A {foreseen} and B {foreseen}." in said
    page = page_of(tmp_path, shadowed)
    contact, approach = "only 1.23 A B 17.0 0.0400", "B 36.0 A 0.00 – – 1 40.0 25.0"
    for words in (contact, approach, "A 5 0.00, 1.20, 0.00 0.00, 1.20 0.0 1.20 0 1.20 –, –, – –"):
        assert words in page.words
    figures = [int(found) for found in re.findall(r"Figure (\d+)\.", page.words)]
    assert figures == list(range(1, len(figures) + 1))
    write_csv(tmp_path / "m.csv", measured([shadowed]))
    row = next(csv.DictReader((tmp_path / "m.csv").read_text().splitlines()))
    assert (row["collisions"], row["impulse"], row["near_to"], row["near_arena_gap"]) == ("1", "0.017", "B", "")
    assert (float(row["shadow_bias_y"]), float(row["intervened_share"])) == (pytest.approx(0.012), 0.1)


def test_tables_of_robots_add_up(two_cases):
    rows = proof_tables([measure(two_cases[1])])[0].rows
    *counts, total = [[int(cell.replace("\u202f", "")) for cell in row.cells[2:]] for row in rows]
    assert total == [sum(column) for column in zip(*counts, strict=True)]
    assert (total[0], total[2]) == (len(two_cases[1].sent.stamp), total[3])
    rows = robot_tables([measure(two_cases[0])])[0].rows
    assert rows[0].cells[0] == ("(TB01)", "turtlebot3")
    assert [row.cells[0][0] for row in rows if row.sum] == ["mean of 3", "mean of 3", "mean of 6"]
    assert left_out([measure(crowd(3, duration=2.0))]) == "The means are over all robots."
    heads = {table.head[0] for table in whole_tables(measured(two_cases))}
    assert not {"Collisions", "Share of all ticks [%]", "Delay of poses [ms]"} & heads, "empty tables"


def test_numbers_have_the_digits_that_they_bear():
    texts = {None: "–", 0.0: "0", 2: "2", 0.2881: "0.288", -4.76: "−4.76", 20517.4: "20\u202f517", 1.234e-4: "1.2e-04"}
    assert [number(value) for value in texts] == [*texts.values()]
    assert [interval(spread(values)) for values in ([4.55, 4.57, 4.59], [50.0] * 2, [])] == ["4.57 ± 0.05", "50.0", "–"]
    assert interval(Spread(-1.23e-7, None, 3.4e-8, 5)) == "−1.2e-07 ± 3e-08"
    assert interval(Spread(50.0, None, 1e-7, 5)) == "50.0 ± 1e-07"


def test_losses_sum_over_robots_and_seeds_everywhere():
    ones = [dataclasses.replace(park(case, seed=seed, duration=2.0), clock="real") for case in "ab" for seed in (1, 2)]
    dead = ones[0].true_position.copy()
    dead[20:, 6] = np.nan
    ones[0] = dataclasses.replace(ones[0], true_position=dead)
    runs = measured([dataclasses.replace(each, lost=each.lost + 1, missed_deadlines=each.lost + 2) for each in ones])
    lost, missed = 2 * len(ones[0].robots), 4 * len(ones[0].robots)
    words = " ".join(each.text for each in findings(runs))
    assert f"Samples were lost: {lost} in a and {lost} in b" in words
    assert f"Deadlines were missed: {missed} in a (" in words
    assert "CF03 dropped out" in words
    (sums,) = [table for table in whole_tables(runs) if table.head[0] == "Sum over all robots and seeds"]
    rows = [("Lost samples", str(lost), str(lost)), ("Missed deadlines", str(missed), str(missed))]
    assert [row.cells for row in sums.rows] == rows
    assert not any("ost" in row.cells[0] for row in summary_table(runs).rows)
