"""The verdict of a soak finds what was planted."""

import json

import pytest
from typer.testing import CliRunner

from agents.network import messages
from experiments.file.document import load
from experiments.real_time.conductor.run_view import Progress, RobotView, RunFailed
from tests.__main__ import command
from tests.cases import for_each
from tests.reliability.soak import Sampler, Soaked, SoakSample, judge, table

ROBOTS = ("TB01", "CF02")
SPAN = 3600.0


def soaked(change, duration_s):
    rows = []
    for k in range(int(duration_s / 5.0)):
        t = 5.0 * k
        for name in (*ROBOTS, "router", "recorder"):
            fields = {"rss_mb": 60.0, "threads": 5, "files": 10, "cpu_s": 0.02 * t}
            if name in ROBOTS:
                fields |= {"lost": 0, "missed": 0, "ticks": 100 * k, "malformed": 0}
                fields |= {"received": 5, "delay_s": 0.002, "longest_s": 0.01}
            fields |= change(name, t) if change else {}
            rows.append(SoakSample(t, name, **fields))
    return Soaked(ROBOTS, duration_s, rows)


def bad(found):
    return [finding.text for finding in found if finding.mark == "bad"]


def of(names, **fields):
    """Other fields of rows of these processes, by the time."""
    return lambda name, t: {field: value(t) for field, value in fields.items()} if name in names else {}


@for_each(
    "change, duration_s, said",
    [
        (None, SPAN, None),
        (of(ROBOTS, rss_mb=lambda t: 60.0 + min(t, 250.0) / 10.0), SPAN, None),  # before the warm-up it does not count
        (of(ROBOTS, rss_mb=lambda t: 60.0 + min(t, 150.0) / 15.0), 420.0, None),
        (of(ROBOTS, rss_mb=lambda t: 60.0 + t), 60.0, None),  # a short run is not judged
        (of(["recorder"], rss_mb=lambda t: 60.0 + t / 1000.0), SPAN, "memory: largest growth after 300 s is +4"),
        (of(["router"], threads=lambda t: 5 + (t > 3500.0)), SPAN, "threads grow: router +1"),
        (of(["TB01"], files=lambda t: 10 + int(t / 600.0)), SPAN, "file descriptors grow: TB01"),
        (of(["CF02"], lost=lambda t: int(t > 1800.0)), SPAN, "lost poses: CF02 1"),
        (of(["CF02"], malformed=lambda t: 3), SPAN, "3 payloads were refused"),
        (of(ROBOTS, delay_s=lambda t: 0.002 + t / 1e5), SPAN, "delay of poses"),
        (of(ROBOTS, received=lambda t: 0), SPAN, "no pose was received"),
    ],
)
def test_verdict_finds_what_was_planted(change, duration_s, said):
    made = soaked(change, duration_s)
    found = bad(judge(made))
    assert len(found) == (said is not None)
    assert not found or found[0].startswith(said)
    assert [row[0] for row in table(made)[1:]] == ["CF02", "TB01", "recorder", "router"]


def test_early_landed_robot_fails_soak_though_process_lives(tmp_path):
    with Sampler(load("triangle").plan, tmp_path) as sampler:
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
