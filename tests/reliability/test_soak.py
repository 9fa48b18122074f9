"""The verdict of a soak finds what was planted."""

import json
from dataclasses import replace

import pytest
from typer.testing import CliRunner

from agents.network import messages
from experiments.file.document import load
from experiments.real_time.conductor.run_view import Progress, RobotView, RunFailed
from tests.__main__ import command
from tests.reliability.soak import judge, passed, table
from tests.reliability.soak_sampler import Sampler, Soaked, SoakSample

ROBOTS = ("TB01", "CF02")
SPAN = 3600.0


def soaked(change=None, *, until=SPAN, **more):
    rows = []
    for k in range(int(until / 5.0)):
        t = 5.0 * k
        for name in (*ROBOTS, "router", "recorder"):
            fields = {"rss_mb": 60.0, "threads": 5, "files": 10, "cpu_s": 0.02 * t}
            if name in ROBOTS:
                fields |= {"lost": 0, "missed": 0, "ticks": 100 * k, "malformed": 0}
                fields |= {"received": 5, "delay_s": 0.002, "longest_s": 0.01}
            if change is not None:
                fields |= change(name, t)
            rows.append(SoakSample(t, name, **fields))
    return Soaked("test", ROBOTS, SPAN, rows, **more)


def bad(found):
    return [finding.text for finding in found if finding.mark == "bad"]


def test_nothing_is_wrong():
    made = soaked()
    assert passed(judge(made))
    assert [row[0] for row in table(made)[1:]] == ["CF02", "TB01", "recorder", "router"]


def test_memory_taken_before_the_warm_up_is_ignored():
    assert passed(judge(soaked(lambda name, t: {"rss_mb": 60.0 + min(t, 250.0) / 10.0})))


def test_pools_filling_early_in_short_runs_are_ignored():
    made = soaked(lambda name, t: {"rss_mb": 60.0 + min(t, 150.0) / 15.0}, until=420.0)
    assert passed(judge(replace(made, duration_s=420.0)))


@pytest.mark.parametrize(
    ("change", "said"),
    [
        (
            lambda name, t: {"rss_mb": 60.0 + t / 1000.0} if name == "recorder" else {},
            "memory grows beyond 2 %: recorder",
        ),
        (lambda name, t: {"threads": 5 + (t > 3500.0)} if name == "router" else {}, "threads grow: router +1"),
        (lambda name, t: {"files": 10 + int(t / 600.0)} if name == "TB01" else {}, "file descriptors grow: TB01"),
        (lambda name, t: {"lost": int(t > 1800.0)} if name == "CF02" else {}, "lost poses: CF02 1"),
        (lambda name, t: {"malformed": 3} if name == "CF02" else {}, "3 payloads were refused"),
        (lambda name, t: {"delay_s": 0.002 + t / 1e5} if name in ROBOTS else {}, "delay of poses"),
        (lambda name, t: {"received": 0} if name in ROBOTS else {}, "no pose was received"),
    ],
)
def test_what_was_planted_is_found(change, said):
    found = bad(judge(soaked(change)))
    assert len(found) == 1
    assert found[0].startswith(said)


def test_the_dead_are_named():
    found = bad(judge(soaked(failed={"CF02": "ended after 12 s"})))
    assert found == ["CF02 ended after 12 s"]


def test_early_landed_robot_fails_soak_though_process_lives(tmp_path):
    with Sampler(load("triangle").plan, tmp_path, "event") as sampler:
        events = [
            ("hazard", "CF01", "hold: silent neighbour KH01"),
            ("hazard", "CF01", "land: battery low: 9 % (limit 10 %)"),
            ("hazard", "CF01", "over: battery low"),
            ("lost", "KH02", "its process has ended"),
        ]
        made = [messages.Event(stamp=0.0, kind=kind, source=source, text=text) for kind, source, text in events]
        sampler(Progress("event", "landing", 3.2, 15.0, {}, made))
        assert bad(judge(sampler.result(interrupted=False)))[:2] == [
            "CF01 did not do its part (land: battery low: 9 % (limit 10 %)) after 3 s",
            "KH02 ended after 3 s",
        ]


def test_memory_of_a_short_run_is_not_judged():
    made = soaked(lambda name, t: {"rss_mb": 60.0 + t}, until=60.0)
    short = Soaked(made.title, made.robots, 60.0, made.rows)
    assert passed(judge(short))
    assert any("not judged" in finding.text for finding in judge(short))


@pytest.mark.parametrize("begun", [True, False])
def test_failed_run_is_judged_and_unstarted_one_errs(begun, tmp_path, monkeypatch):
    def broken(read, folder, options, user):
        with user.show as show:
            if begun:
                show(Progress("event", "running", 3.0, 6.0, {"CF01": RobotView()}))
            raise RunFailed("the conductor stood still for 9.0 s: its robots have landed")

    monkeypatch.setattr("tests.reliability.soak.conduct", broken)
    out = tmp_path / "soak"
    words = ["triangle", "--minutes", "0.1", "--json", "--out", str(out)]
    done = CliRunner().invoke(command("--soak"), words, standalone_mode=False)
    assert (out / "soak.csv").exists()
    if begun:
        assert done.return_value == 1
        texts = [finding["text"] for finding in json.loads(done.stdout)["findings"]]
        assert "the run ended early: the conductor stood still for 9.0 s: its robots have landed" in texts
    else:
        assert isinstance(done.exception, RunFailed)
