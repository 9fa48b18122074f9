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
from experiments.metrics.statistics import spread
from experiments.recording.run_folder import RunOrigin
from experiments.report import report
from experiments.report.metrics_files import write_csv
from experiments.report.page import Section, Table, TableRow, date_of, inline, interval, number
from experiments.report.tables import events_tables, proof_tables, robot_tables, summary_table, whole_tables
from experiments.report.verdict import findings, left_out
from tests.experiments.traces import at_origin, crowd, cut, park, trace

pytestmark = pytest.mark.slow  # runs and reports, whole

VOID = {"meta", "link", "br", "hr", "img", "input"}


class Page(HTMLParser):
    """Checks that elements close, and collects ids, references and text."""

    def __init__(self, html: str) -> None:
        super().__init__()
        self.open: list[str] = []
        self.ids: list[str] = []
        self.wanted: set[str] = set()
        self.tags: set[str] = set()
        self.text: list[str] = []
        self.feed(html)
        self.close()

    def handle_starttag(self, tag, attrs):
        if tag not in VOID:
            self.open.append(tag)
        self.handle_startendtag(tag, attrs)

    def handle_startendtag(self, tag, attrs):
        self.tags.add(tag)
        for name, value in attrs:
            if name == "id":
                self.ids.append(value)
            self.wanted |= set(re.findall(r"url\(#([^)]*)\)", value or ""))
            if name in {"href", "xlink:href", "src", "aria-labelledby"}:
                self.wanted.add(value.removeprefix("#"))
            assert not name.startswith("on")

    def handle_endtag(self, tag):
        assert self.open.pop() == tag

    def handle_data(self, data):
        self.text.append(data)

    @property
    def words(self) -> str:
        return re.sub(r"[ \n]+", " ", " ".join(self.text))


def checked_page(html: str) -> Page:
    page = Page(html)
    assert page.open == []
    assert len(page.ids) == len(set(page.ids))
    assert page.wanted <= set(page.ids)
    assert not page.tags & {"iframe", "img", "link", "object"}
    assert html.count("<script") <= 1, "that of the replay"
    assert not re.findall(r"https?://", re.sub(r'xmlns(:\w+)?="[^"]*"', "", html))
    return page


def page_of(folder, *traces, **more):
    return checked_page(report.write(folder, traces, **more).read_text("utf-8"))


def measured(traces):
    return [measure(trace) for trace in traces]


def marks_of(*traces):
    """Marks of the verdict, by text."""
    return {finding.text: finding.mark for finding in findings(measured(traces))}


@pytest.fixture(scope="module")
def two_cases():
    return [park(), park("event", 0.01)]


@pytest.fixture(scope="module")
def written(tmp_path_factory, two_cases):
    """The report of the run as HTML; written twice it is the same."""
    folder = tmp_path_factory.mktemp("written")
    (folder / "run.json").write_bytes(msgspec.json.encode(RunOrigin("zenpark run <this> --seed 1", "2030-01-02")))

    def again():
        return report.write(folder / "new" / "run", two_cases, run=folder, notes=["It rained."])

    path = again()
    assert path == folder / "new" / "run" / "report.html"
    html = path.read_text("utf-8")
    assert again().read_text("utf-8") == html
    return html


def test_report_of_a_run_stands_alone(written):
    page = checked_page(written)
    assert page.ids.count("f1-figure_1") == page.ids.count("f7-figure_1") == 1
    for words in (
        "Robotic Park: six robots hold a rigid formation behind a leader",
        "Nobody, Nowhere 2020",
        "2030-01-02",
        "It rained.",
        "zenpark run <this> --seed 1",
        "TB01 leads and is left out of the means.",
        "No pose was lost: 17\u202f",
        "Figure 7.",
        "all robots are ready",
        "ITAE",
    ):
        assert words in page.words
    assert len(written.encode()) < 1_500_000


def test_contents_link_every_section_and_details_are_folded(written):
    html = written
    links = re.findall(r'href="#([^"]*)"', html[html.index("<nav") : html.index("</nav>")])
    assert links[:5] == ["verdict", "replay", "results", "figures", "events"]
    assert html.index('id="verdict"') < html.index('class="facts"') < html.index('id="results"')
    folded = {anchor for anchor in links if f'<div id="{anchor}">' in html}
    assert set(links) - folded == {"verdict", "replay", "results", "figures", "events"}
    assert {"each-robot", "data-integrity", "experiment-file", "definitions"} <= folded


def test_only_telling_events_stand_open():
    said = (Event(0.0, "robot", "A", "running"), Event(1.0, "hazard", "A", "hold: no position"))
    known = dataclasses.replace(crowd(3, duration=2.0), events=said)
    short, every = events_tables([known])
    assert [row.cells[2] for row in short.rows] == ["hazard"]
    assert every is not None
    assert (every[0], len(every[1].rows)) == ("All 2 events", 2)
    quiet, every = events_tables([dataclasses.replace(known, events=said[1:])])
    assert len(quiet.rows) == 1
    assert every is None


def test_an_event_of_all_cases_is_one_row():
    legs = [Event(at, "phase", "conductor", "leader under way") for at in (5.0, 9.0)]
    late = Event(7.0, "phase", "conductor", "leader under way")
    first = dataclasses.replace(crowd(3, "a", duration=1.0), events=(legs[0], legs[1]))
    second = dataclasses.replace(first, case="b", events=(Event(5.1, *msgspec.structs.astuple(legs[0])[1:]), late))
    short, _ = events_tables([first, second])
    assert [row.cells[:2] for row in short.rows] == [("all", "5.00"), ("a", "9.00"), ("b", "7.00")]


def test_tables_wider_than_half_a_page_stand_alone():
    narrow, wide = (Table(("Mean", "a"), (TableRow(("IAE", cell)),)) for cell in ("1.0", "1.0 ± " * 20))
    assert Section("Results", tables=(narrow,) * 3).packed
    assert not Section("Results", tables=(narrow, narrow, wide)).packed
    assert not Section("Results", tables=(narrow,) * 2).packed


def test_report_of_one_case_has_no_ratio_figure(tmp_path):
    page = page_of(tmp_path, crowd(3, duration=3.0), text="[file]\nx = '<b>'")
    assert "Figure 6." in page.words
    assert "Figure 7." not in page.words
    assert "x = '<b>'" in page.words


def test_markup_in_names_stays_text(tmp_path):
    bad = '<script>alert("1")</script> & {{ 7 * 7 }} $\\frac$'
    what = dataclasses.replace(crowd(3, duration=2.0), events=(Event(1.0, bad, bad, bad),), case=bad)
    assert page_of(tmp_path, what, date=bad).words.count(bad) > 5


def test_many_events_are_cut(tmp_path):
    known = dataclasses.replace(crowd(3, duration=2.0), events=tuple(Event(0.0, "a", "b", "c") for _ in range(250)))
    assert "50 more are in the recording." in page_of(tmp_path, known, drawings={}).words


def test_report_over_seeds_gives_intervals(tmp_path):
    runs = [park(name, size, seed=seed, duration=8.0) for name, size in (("a", 0.0), ("b", 0.02)) for seed in (1, 2, 3)]
    page = page_of(tmp_path, *runs)
    assert "Whiskers: 95 % confidence over 3 seeds." in page.words
    assert "1 to 3" in page.words
    cells = summary_table(measured(runs)).rows[3].cells
    assert re.fullmatch(r"\d\.\d+ ± 0\.\d+", cells[1])
    assert re.fullmatch(r"× \d\.\d+ ± 0\.\d+", cells[2][1])


def test_report_of_run_with_dead_robot_and_losses(tmp_path):
    known = park(duration=10.0)
    place = known.true_position.copy()
    place[100:, 6] = np.nan
    lost = np.array([0, 3, 0, 0, 0, 0, 0])
    known = dataclasses.replace(known, true_position=place, lost=lost, missed_deadlines=lost, clock="real")
    page = page_of(tmp_path, known)
    for words in (
        "CF03 dropped out; the means leave it out.",
        "Samples were lost: 3 in periodic",
        "Deadlines were missed: 3 in periodic (",
        "Known [%]",
    ):
        assert words in page.words


@pytest.mark.parametrize(
    ("names", "shown"),
    [
        (("monday", "tuesday"), ("monday · periodic", "monday · event", "tuesday", "relative to monday · periodic.")),
        (("a", "a", "a"), ("a, a (2), a (3)", "relative to a.", "a (3) · event")),
    ],
)
def test_comparison_has_a_column_per_run_and_case(tmp_path, two_cases, names, shown):
    cases = (two_cases, two_cases[1:]) if len(names) == 2 else (two_cases[:1], two_cases[:1], two_cases)
    runs = [(name, measured(each)) for name, each in zip(names, cases, strict=True)]
    page = checked_page(report.compare(tmp_path / "there" / "compare.html", runs).read_text())
    for words in shown:
        assert words in page.words
    assert "±" not in page.words.split("Definitions")[0]
    assert "95 % confidence over" not in page.words
    assert "Seeds" not in page.words


def test_comparison_shows_first_how_the_runs_differ(tmp_path, two_cases):
    differ = [("A", "runs/a", []), ("B", "runs/b", ["duration_s 45 → 44", "seeds: 1 → 2", "x 1 → 2"])]
    path = report.compare(
        tmp_path / "c.html", [("A", measured(two_cases[:1])), ("B", measured(two_cases[1:]))], differences=differ
    )
    html = path.read_text(encoding="utf-8")
    said = checked_page(html).words.split("</style>")[-1]
    assert "! B differs in duration_s 45 → 44; seeds: 1 → 2 and 1 more." in said
    assert html.index('id="differences"') < html.index('id="results"')
    assert "A runs/a the reference B runs/b duration_s 45 → 44; seeds: 1 → 2; x 1 → 2" in said


def test_an_interrupted_run_says_so_first(tmp_path):
    words = page_of(tmp_path, cut(park(duration=45.0), 7.9), notes=["It rained."]).words
    first = words.split("In short")[2]
    assert first.split("It rained.")[0].strip(" !") == "Interrupted after 7.9 s of 45 s: all figures are up to there."
    for shown in ("Duration 7.9 s of 45 s", "Mean per robot", "Acquired [s]"):
        assert shown in words
    assert "Acquired by all followers [s] periodic from the start" in words
    for absent in ("dropped out", "never stayed", "After the leg"):
        assert absent not in words


def test_interrupted_before_the_formation_was_there():
    said = marks_of(cut(park(), 1.0))
    assert said["The formation was not within 5 cm when periodic was interrupted."] == "plain"
    assert "bad" not in said.values()


def test_one_of_two_cases_interrupted():
    cases = [measure(park("a")), measure(cut(park("b", 0.01), 10.0))]
    said = [each.text for each in findings(cases)]
    assert said[0] == "b was interrupted after 10.0 s of 45 s: all its figures are up to there."
    assert "Runs of different length of b and a are not compared." in said
    assert any(text.startswith("After the leg at 21 s it was acquired by all again after") for text in said)
    assert not any("never" in text for text in said)
    assert {row.cells[0]: row.cells[2] for row in summary_table(cases).rows}["IAE [m s]"]


def test_a_report_made_again_keeps_date_and_command(tmp_path):
    known = crowd(3, duration=2.0)
    (tmp_path / "run.json").write_bytes(msgspec.json.encode(RunOrigin("zenpark run x.toml", "2031-02-03")))
    for page in (
        page_of(tmp_path, known, date="2032-01-01", drawings={}),
        page_of(tmp_path / "new", known, run=tmp_path, drawings={}),
    ):
        assert "zenpark run x.toml" in page.words
        assert "2031-02-03" in page.words
        assert "2032" not in page.words
    assert not (tmp_path / "new" / "run.json").exists()


@pytest.mark.parametrize("text", ["", "{", '{"title": "the case named run"}', None])
def test_without_a_command_nothing_is_kept(tmp_path, text):
    """Another file of that name is left alone."""
    file = tmp_path / "run.json"
    if text is not None:
        file.write_text(text)
    page = page_of(tmp_path, crowd(3, duration=2.0), date=date_of(1.76e9), drawings={})
    assert "2025-10-09 08:53 UTC" in page.words
    assert "Reproduce" not in page.words
    assert '"duration_s": 2.0' in page.words, "the experiment is shown even without its file"
    assert (file.read_text() if file.exists() else None) == text


def test_nothing_to_report():
    with pytest.raises(ValueError, match="no case"):
        report.write("x", [])  # type: ignore[arg-type]
    with pytest.raises(ValueError, match="no run"):
        report.compare("x", [("a", [])])  # type: ignore[arg-type]


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
        rf".*After the leg at 21 s it was acquired by all again after {after:.2f} s \(periodic\)",
    ):
        assert any(re.match(words, text) for text in said), words
    ratio = event.mean["iae"] / periodic.mean["iae"]
    assert [mark for text, mark in said.items() if f"IAE {ratio:.3f}" in text] == ["plain"]
    failed = findings([msgspec.structs.replace(periodic, failures=("CF01 was lost",))])
    assert [each.mark for each in failed if each.text.startswith("No pose was lost")] == ["plain"]
    same = findings([periodic, msgspec.structs.replace(periodic, case="again")])
    as_many = "again needs as many transmissions as periodic: "
    assert [each.mark for each in same if each.text.startswith(as_many)] == ["plain"]


def test_verdict_of_a_formation_never_acquired():
    what = at_origin({"L": "turtlebot3", "F": "khepera4"}, {"L > F": 1.0})
    place = np.zeros((200, 2, 3))
    place[:, 1, 0] = 1.5
    place[:, 1, 1] = 2.1
    said = marks_of(trace(what, place))
    assert said["The formation never stayed within 5 cm in only."] == "bad"
    assert said["F was 10.0 cm outside the arena in only."] == "bad"


def side_by_side(*, apart=0.5, seed=1):
    """Two Kheperas that stand for two seconds, in an arena without walls."""
    what = at_origin({"A": "khepera4", "B": "khepera4"}, {"A - B": apart}, arena=Arena(walls=False))
    place = np.zeros((101, 2, 3))
    place[:, 1, 0] = apart
    return trace(what, place, seed=seed)


def test_verdict_gives_nearest_distance_if_nothing_touched():
    text = "No robot touched another or the arena; the closest approach was 36.0 cm between robots (A–B at 0.0 s)."
    assert marks_of(side_by_side())[text] == "good"
    walled = marks_of(park("a"), park("b")).items()
    (text,) = [text for text, mark in walled if text.startswith("No robot touched") and mark == "good"]
    assert re.search(r" cm between robots \(\w+–\w+ at [\d.]+ s, [ab]\) and ", text)
    assert re.search(r" cm between robot and arena \(\w+–wall at [\d.]+ s, [ab]\)\.$", text)


def test_verdict_names_collisions():
    text = "One collision in only: A–B at 0.00 s (4.00 cm deep)."
    assert marks_of(side_by_side(apart=0.1))[text] == "bad"
    contacts = tuple(Contact(0.5 * k, "A", "wall" if k else "B", 0.012 * k, 0.0003) for k in range(5))
    seen = dataclasses.replace(side_by_side(), contacts=contacts)
    text = (
        "5 collisions in only: A–B at 0.00 s (0 mN s, 0.0300 cm deep), A–wall at 0.50 s (12.0 mN s, 0.0300 cm deep), "
        "A–wall at 1.00 s (24.0 mN s, 0.0300 cm deep) and 2 more."
    )
    assert marks_of(seen)[text] == "bad"
    seeds = [side_by_side(), side_by_side(apart=0.1, seed=2)]
    assert marks_of(*seeds)["One collision in 1 of 2 seeds of only: A–B at 0.00 s (4.00 cm deep)."] == "bad"


def test_verdict_on_a_world_that_fell_behind():
    def paced(*factors, clock="real"):
        states = [WorldState(float(k), "pymunk", 0.0, each, 0.1, each == 0.0, []) for k, each in enumerate(factors)]
        return dataclasses.replace(side_by_side(), world=tuple(states), clock=clock)

    text = "The world fell behind: at its slowest it ran at 0.93 of real time, in only."
    assert marks_of(paced(1.0, 0.93, 0.0))[text] == "fair"  # it was paused in the end
    assert marks_of(paced(1.0, 0.5))[text.replace("0.93", "0.50")] == "bad"
    assert not any("world" in said for said in marks_of(paced(1.0, 0.995)))
    assert not any("world" in said for said in marks_of(paced(0.5, clock="virtual")))


def test_report_shows_avoidance_and_shadow_twins(tmp_path):
    plain = side_by_side()
    given = plain.plan.experiment.robots
    robots = {name: msgspec.structs.replace(robot, shadow=Shadow()) for name, robot in given.items()}
    known = dataclasses.replace(
        plain,
        plan=plain.plan.changed(robots=robots),
        contacts=(Contact(1.234, "A", "B", 0.017, 0.0004),),
        interventions=np.array([10, 40]),
        avoided=np.array([0, 25]),
        ticks=np.array([100, 100]),
        shadow_position=plain.position + np.array([0.0, 0.012, 0.0]),
        shadow_yaw=plain.yaw,
    )
    said = marks_of(known)
    assert said["Avoidance was at work on 12.5 % of all ticks in only, most on those of B (25)."] == "plain"
    assert (
        "Twins beside robots foresaw A to 1.20 cm RMSE up to 5 s ahead (only) and B to 1.20 cm RMSE up to 5 s ahead "
        "(only)."
    ) in said
    page = page_of(tmp_path, known)
    for words in (
        "Contacts are those that the world saw begin",
        "only 1.23 A B 17.0 0.0400",
        "B 36.0 A 0.00 – – 1 40.0 25.0",
        "A 5 0.00, 1.20, 0.00 0.00, 1.20 0.0 1.20 0 1.20 –, –, – –",
        "Robots and the twins beside them",
    ):
        assert words in page.words
    figures = [int(found) for found in re.findall(r"Figure (\d+)\.", page.words)]
    assert figures == list(range(1, len(figures) + 1))
    write_csv(tmp_path / "m.csv", measured([known]))
    row = next(csv.DictReader((tmp_path / "m.csv").read_text().splitlines()))
    assert (row["collisions"], row["impulse"], row["near_to"], row["near_arena_gap"]) == ("1", "0.017", "B", "")
    assert (float(row["shadow_bias_y"]), float(row["intervened_share"])) == (pytest.approx(0.012), 0.1)


def test_tables_have_one_unit_and_no_empty_rows(two_cases):
    def tables_of(*traces):
        return {table.head[0]: [row.cells[0] for row in table.rows] for table in whole_tables(measured(traces))}

    tables = tables_of(*two_cases)
    assert tables["Acquired by all followers [s]"] == ["from the start", "after 21 s"]
    assert tables["Distances [cm]"][:2] == ["Worst link before 21 s", "Worst link at the end"]
    assert not {"Collisions", "Share of all ticks [%]", "Delay of poses [ms]"} & set(tables)
    assert not any("[" in row for rows in tables.values() for row in rows)
    assert tables_of(dataclasses.replace(two_cases[0], clock="real"))["Delay of poses [ms]"] == ["mean", "longest"]


def test_left_out_of_the_means(two_cases):
    assert left_out([measure(two_cases[0])]) == "TB01 leads and is left out of the means."
    assert left_out([measure(crowd(3, duration=2.0))]) == "The means are over all robots."


def test_proof_adds_up(two_cases):
    rows = proof_tables([measure(two_cases[1])])[0].rows
    counts = [[int(cell.replace("\u202f", "")) for cell in row.cells[2:]] for row in rows]
    assert counts[-1] == [sum(column) for column in zip(*counts[:-1], strict=True)]
    assert counts[-1][2] == counts[-1][3]
    assert counts[-1][0] == len(two_cases[1].sent.stamp)


def test_robot_table_has_means_by_kind(two_cases):
    table = robot_tables([measure(two_cases[0])])[0]
    assert table.rows[0].cells[0] == ("(TB01)", "turtlebot3")
    assert [row.cells[0] for row in table.rows if row.sum] == [
        ("mean of 3", "khepera4"), ("mean of 3", "crazyflie"), ("mean of 6", "")
    ]  # fmt: skip


@pytest.mark.parametrize(
    ("value", "text"),
    [(None, "–"), (0.0, "0"), (2, "2"), (50.0, "50.0"), (0.2881, "0.288"), (-4.76, "−4.76"), (0.03271, "0.0327"),
     (20517.4, "20\u202f517"), (0.0001234, "1.2e-04")],
)  # fmt: skip
def test_numbers_have_three_digits(value, text):
    assert number(value) == text


def test_intervals_show_the_digits_that_they_bear():
    assert interval(spread([4.55, 4.57, 4.59])) == "4.57 ± 0.05"
    assert interval(spread([50.0, 50.0])) == "50.0"
    assert interval(spread([])) == "–"


def test_inline_drawings_have_ids_of_their_own():
    drawing = (
        '<?xml version="1.0"?><svg width="9pt" viewBox="0 0 9 9" xmlns="a"><defs><path id="p"/></defs>'
        '<use xlink:href="#p"/><g id="g" style="stroke: #000000" clip-path="url(#p)"/></svg>'
    )
    placed = inline(drawing, "f3-", 'A "b" & <c>')
    assert placed == (
        '<svg viewBox="0 0 9 9" role="img" aria-label="A &quot;b&quot; &amp; &lt;c>"><defs><path id="f3-p"/></defs>'
        '<use href="#f3-p"/><g id="f3-g" style="stroke: currentColor" clip-path="url(#f3-p)"/></svg>'
    )


def test_losses_sum_over_robots_and_seeds_everywhere():
    ones = [dataclasses.replace(park(case, seed=seed, duration=2.0), clock="real") for case in "ab" for seed in (1, 2)]
    runs = measured([dataclasses.replace(each, lost=each.lost + 1, missed_deadlines=each.lost + 2) for each in ones])
    robots = len(ones[0].robots)
    words = " ".join(each.text for each in findings(runs))
    assert f"Samples were lost: {2 * robots} in a and {2 * robots} in b" in words
    assert f"Deadlines were missed: {4 * robots} in a (" in words
    (sums,) = [table for table in whole_tables(runs) if table.head[0] == "Sum over all robots and seeds"]
    lost, missed = str(2 * robots), str(4 * robots)
    assert [row.cells for row in sums.rows] == [("Lost samples", lost, lost), ("Missed deadlines", missed, missed)]
    assert not any("ost" in row.cells[0] for row in summary_table(runs).rows)


def test_seeds_that_begin_alike_are_named(tmp_path):
    runs = [park(seed=seed, duration=2.0) for seed in (1, 2)]
    assert "All seeds begin at the same poses" in report.write(tmp_path / "a", runs, drawings={}).read_text()
    scattered = runs[0].plan.changed(start=Start(scatter=0.1))
    apart = [dataclasses.replace(each, plan=scattered) for each in runs]
    assert "begin at the same poses" not in report.write(tmp_path / "b", apart, drawings={}).read_text()
