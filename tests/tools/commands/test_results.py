"""Reports that are made again, tables for papers, and the lines that a run prints."""

import json
import os
import re
import shutil
from pathlib import Path
from types import SimpleNamespace

import pytest

from agents.errors import ExplainedError
from experiments.file.problems import DocumentError
from experiments.metrics.statistics import spread
from experiments.recording.cleaning import using
from experiments.report.tables import ratio_words
from tests.commands import invoke
from tests.experiments.recordings import small_disk
from tools.commands import results
from tools.commands.run import _acquired
from tools.options import known_words

pytestmark = pytest.mark.slow  # whole runs and their reports

SHORT = """
title = "Two, for three seconds"
duration_s = 3.0
disturbance = { all = { position_sigma = 0.001 } }
[robots]
A = { kind = "khepera4", start = [-0.4, 0.0] }
B = { kind = "khepera4", start = [0.4, 0.1] }
[formation.links]
"A - B" = 0.5
[cases.periodic]
[cases.event]
trigger = { kind = "send-on-delta", threshold = 0.01 }
"""


def stdout_of(*words, code=0):
    return invoke(*words, code=code).stdout


def refused_command(*words):
    error = invoke(*words, code=None).exception
    assert isinstance(error, ExplainedError)
    return str(error)


@pytest.fixture(scope="module")
def three_seeds(tmp_path_factory):
    """Folder of a run of two cases and three seeds, and what the command printed."""
    folder = tmp_path_factory.mktemp("results")
    (folder / "short.toml").write_text(SHORT)
    return folder / "run", stdout_of("run", folder / "short.toml", "--virtual", "--seeds", 3, "--out", folder / "run")


@pytest.fixture
def first(three_seeds):
    return three_seeds[0]


@pytest.fixture
def again(first, tmp_path):
    return shutil.copytree(first, tmp_path / "run")


@pytest.fixture
def another(first, tmp_path):
    """A run of the same file with one seed and other options; returns its folder and what was printed."""

    def rerun(*options, folder="x", code=0):
        words = ["run", first.parent / "short.toml", "--virtual", "--no-report", "--out", tmp_path / folder, *options]
        return tmp_path / folder, stdout_of(*words, code=code)

    return rerun


def test_new_report_keeps_seeds_without_recordings(first, again):
    for k, file in enumerate(("event.mcap", "periodic.mcap")):
        os.utime(again / file, (k, k))  # as unpacked from an archive: the reference stays the first one
    found = json.loads(stdout_of("report", again, "--json"))
    assert found["runs"][0]["across"]["seeds"] == [1, 2, 3]
    before, after = (json.loads((folder / "metrics.json").read_bytes()) for folder in (first, again))
    assert [(each["case"], each["seed"]) for each in after] == [(each["case"], each["seed"]) for each in before]
    assert after[2:] == before[2:]
    assert "median and range of 3 seeds" in (again / "report.html").read_text()
    assert (again / "figures/errors.csv").read_bytes() == (first / "figures/errors.csv").read_bytes()


def test_figure_of_errors_stays_without_all_seeds_errors(first, again):
    (again / "figures/errors.csv").unlink()
    stdout_of("report", again)
    assert (again / "figures/errors.svg").read_bytes() == (first / "figures/errors.svg").read_bytes()


def test_metrics_of_another_version_are_not_overwritten(again):
    before = (again / "metrics.json").read_text().replace('"iae"', '"iae_of_old"')
    (again / "metrics.json").write_text(before)
    assert refused_command("report", again)
    assert (again / "metrics.json").read_text() == before


def test_paper_tables_are_over_seeds_with_chosen_metrics(first, tmp_path):
    for form, sign in (("--latex", r"\pm"), ("--markdown", "±")):
        text = stdout_of("report", first, form)
        assert "3 seeds" in text
        assert text.count(sign) > 10
    file = tmp_path / "paper" / "t.tex"
    assert stdout_of("report", first, "--latex", "--out", file, "--metrics", "f,iae").strip() == str(file)
    rows = [line for line in file.read_text().splitlines() if line.startswith(("f ", "IAE", "ITAE", "RMSE"))]
    assert [row.split(" [")[0] for row in rows] == ["f", "IAE"]
    assert "--metrics speed: is not known" in refused_command("report", first, "--latex", "--metrics", "speed")
    with pytest.raises(DocumentError, match="did you mean 'acquired'"):
        known_words("--metrics", ["acquired_s"], ["f", "iae", "acquired"])


def test_console_gives_the_digits_an_interval_supports(three_seeds):
    lines = three_seeds[1].splitlines()
    half = re.search(r"IAE (\d\.\d+) ± (\d\.\d+) m s, ", lines[0])
    assert len(half[1]) == len(half[2])
    assert re.search(r"\(ratios: f \d\.\d+ ± \d\.\d+, IAE \d\.\d+ ± \d\.\d+\)", lines[1])
    assert ratio_words(spread([0.0610, 0.0611, 0.0612])) == "0.0611 ± 0.0002"


def test_sweep_has_figures_and_a_paper_table(first, tmp_path):
    folder, figures = tmp_path / "swept", tmp_path / "swept" / "figures"
    said = stdout_of("sweep", first.parent / "short.toml", "trigger.threshold=0.01,0.05", "seeds=2", "--out", folder)
    assert f"figures: {figures}" in said
    narrow = (figures / "pareto_iae.svg").read_text()
    assert stdout_of("report", folder, "--width", "7.16", "--pdf").strip() == str(figures)
    assert (figures / "pareto_iae.svg").read_text() != narrow
    assert {file.stem for file in figures.glob("*.pdf")} == {"pareto_iae", "pareto_itae"}
    assert "event & 0.05 & " in stdout_of("report", folder, "--latex")
    chosen = stdout_of("report", folder, "--latex", "--metrics", "messages,iae").splitlines()
    assert r"Case & threshold [m] & Messages ratio & IAE ratio \\" in chosen
    (known,) = json.loads(stdout_of("runs", "--past", "--in", tmp_path, "--json"))["sweeps"]
    assert (known["folder"], known["cells"], known["seeds"]) == (str(folder), 3, [1, 2])


def test_runs_of_several_seeds_are_pooled_to_one(first, another, tmp_path):
    runs = [another("--seed", seed, folder=f"seed{seed}")[0] for seed in (1, 2, 3)]
    tables = stdout_of("report", *runs, "--pool", "--latex", "--metrics", "f,iae")
    assert tables == stdout_of("report", first, "--latex", "--metrics", "f,iae")
    page = tmp_path / "seed1-pooled" / "report.html"
    assert stdout_of("report", *runs, "--pool").strip() == str(page)
    assert "median and range of 3 seeds" in page.read_text()
    assert "seed 1 is there twice" in refused_command("report", runs[0], runs[0], "--pool")
    other, _ = another("--set", "duration_s=2.5")
    assert "differs from" in refused_command("report", runs[1], other, "--pool")


def test_a_comparison_has_the_intervals_of_the_report(three_seeds, again, tmp_path):
    first, printed = three_seeds
    (again / "event.mcap").unlink()  # `clean --recordings` leaves the metrics
    page = tmp_path / "comparison.html"
    lines = stdout_of("report", first, tmp_path, "--out", page).splitlines()
    assert re.fullmatch(rf"B +{re.escape(str(again))} +the same file, seeds and versions", lines[2])
    event = next(line for line in lines if line.startswith("B · event "))
    (reported,) = [line for line in printed.splitlines() if line.startswith("       event: ")]
    rate, error = re.findall(r"(\d[\d.]* ± [\d.]+)", reported)[:2]
    assert rate in event
    assert error in event
    assert re.search(r" × 0\.\d+ ± 0\.\d+", event)
    assert lines[-1] == str(page)
    found = json.loads(stdout_of("report", first, again, "--out", page, "--json"))
    assert found["differences"] == {str(again): []}
    figures = found["runs"][0]["cases"]["event"]["iae"]
    assert figures["n"] == 3
    assert figures["ci95"] > 0.0


def test_interrupted_run_over_seeds_reports_what_is_kept(first, tmp_path, monkeypatch):
    def interrupted(*_, folder, **__):
        (folder / "event.mcap").touch()
        raise KeyboardInterrupt

    monkeypatch.setattr("experiments.run.simulate_seeds", interrupted)
    options = ["--virtual", "--seeds", "60", "--out", tmp_path / "run"]
    done = invoke("run", first.parent / "short.toml", *options, code=None)
    assert done.exit_code != 0
    assert "interrupted: kept is seed 1 of event" in done.stderr


def test_seeds_that_never_acquire_are_counted():
    def measured(*acquired):
        robots = [SimpleNamespace(robot=f"R{k}", acquired_s=when) for k, when in enumerate(acquired)]
        mean = {"acquired_s": None if None in acquired else 1.0}
        return SimpleNamespace(mean=mean, robots=robots, leaders=(), died=())

    some, never = measured(5.4, 5.5), measured(5.4, None)
    for runs, words in (
        ([some, some], "acquired after 7.8 s (mean)"),
        ([some, never], "acquired after 7.8 s (mean of 1 of 2 seeds, the others never)"),
        ([never], "not acquired by all (1 of 2 robots were there)"),
        ([never, never], "not acquired by all in any of 2 seeds (2 of 4 robots were there)"),
    ):
        assert _acquired("7.8", runs) == words


def test_a_spoiled_run_is_not_compared(first, another, tmp_path):
    out, printed = another("--set", "cases.event.safety.battery_low=0.999999", "--anyway", code=1)
    assert "✗ Spoiled, and compared with nothing: event: robots failed." in printed
    compared = stdout_of("report", first, out, "--out", tmp_path / "comparison.html")
    assert "×" not in next(line for line in compared.splitlines() if line.startswith("B · event "))
    assert "robots failed" in stdout_of("runs", "--past", "--in", out)
    assert "is no whole run that nothing spoiled" in refused_command("report", out, first, "--pool")


def test_runs_say_where_none_can_be_listed(tmp_path, monkeypatch, capsys):
    monkeypatch.setenv("ZENPARK_RUNTIME_DIR", str(tmp_path))
    for mode, words in ((0o755, "runs may be up that are not listed: "), (0o700, "no run is listed in ")):
        tmp_path.chmod(mode)
        results.runs()
        assert capsys.readouterr().out.startswith(f"{words}{tmp_path}")


def test_figures_are_printed_though_the_disk_is_full(first, tmp_path):
    words = ["run", first.parent / "short.toml", "--virtual", "--out", tmp_path / "run"]
    with small_disk():
        done = invoke(*words, code=1)
    assert done.stdout.count(" Hz per robot, IAE ") == 2
    assert f"{tmp_path / 'run' / 'periodic.mcap'}: cannot be written: File too large; make room there" in done.stderr
    assert (tmp_path / "run" / "metrics.json").is_file()
    with small_disk(100):
        error = invoke(
            "sweep", first.parent / "short.toml", "seeds=1", "--out", tmp_path / "swept", code=None
        ).exception
    assert error.filename == str(tmp_path / "swept")


def test_run_that_is_up_is_not_reported(again, tmp_path):
    with using(again):
        assert "this run is still up" in refused_command("report", again)
        assert "this run is still up" in refused_command("export", again, "--csv")
    (again / "event.mcap").write_bytes((again / "event.mcap").read_bytes()[:-1])
    assert "event: the recording was cut off" in invoke("report", again).stderr


def test_place_of_a_report_has_one_meaning(again, tmp_path, monkeypatch):
    assert "is a folder with its figures" in refused_command("report", again, "--out", tmp_path / "x.html")
    monkeypatch.setenv("HOME", str(tmp_path))
    invoke("report", again, "--out", "~/made")
    assert (tmp_path / "made" / "report.html").is_file()
    assert not Path("~").exists()


def test_missing_figures_are_remarked_and_sweeps_named(first, again, tmp_path):
    (again / "metrics.json").write_text("[1, 2")
    assert f"metrics.json cannot be read: `./zenpark report {again}`" in stdout_of("runs", "--past", "--in", again)
    (tmp_path / "sweep.json").write_text("{}")
    assert "is that of a sweep, which keeps no recordings" in refused_command("export", tmp_path, "--bundle")
