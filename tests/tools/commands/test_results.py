"""Reports that are made again, tables for papers, and the lines that a run prints."""

from __future__ import annotations

import json
import os
import re
import shutil
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
from typer.testing import CliRunner

from experiments.file.problems import DocumentError
from experiments.metrics.statistics import spread
from experiments.report.tables import ratio_words
from tests.experiments.recording.test_bundle import SHORT
from tools.commands.run import _acquired
from tools.main import app
from tools.options import known_words

pytestmark = pytest.mark.slow  # whole runs and their reports


def zenpark(*words: str) -> str:
    done = CliRunner().invoke(app, [*words])
    assert done.exit_code == 0, done.output
    return done.stdout


@pytest.fixture(scope="module")
def three(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, str]:
    """Folder of a run of two cases and three seeds, and what the command printed."""
    folder = tmp_path_factory.mktemp("results")
    (folder / "short.toml").write_text(SHORT)
    out = str(folder / "run")
    return folder / "run", zenpark("run", str(folder / "short.toml"), "--virtual", "--seeds", "3", "--out", out)


def test_new_report_keeps_seeds_without_recordings(three: tuple[Path, str], tmp_path: Path) -> None:
    again = tmp_path / "run"
    shutil.copytree(three[0], again)
    for k, file in enumerate(("event.mcap", "periodic.mcap")):
        os.utime(again / file, (k, k))  # as unpacked from an archive: the reference stays the first one
    found = json.loads(zenpark("report", str(again), "--json"))
    assert found["runs"][0]["across"]["seeds"] == [1, 2, 3]
    before, after = (json.loads((folder / "metrics.json").read_bytes()) for folder in (three[0], again))
    assert [(each["case"], each["seed"]) for each in after] == [(each["case"], each["seed"]) for each in before]
    assert after[2:] == before[2:]
    assert "median and range of 3 seeds" in (again / "report.html").read_text()
    assert (again / "figures/errors.csv").read_bytes() == (three[0] / "figures/errors.csv").read_bytes()


def test_figures_are_pdf_on_demand(three: tuple[Path, str], tmp_path: Path) -> None:
    again = tmp_path / "run"
    shutil.copytree(three[0], again)
    assert not list(again.glob("figures/*.pdf"))
    assert "./zenpark report FOLDER --pdf" in (again / "report.html").read_text()
    assert "./zenpark report FOLDER --pdf" in " ".join(zenpark("run", "--help").split())
    zenpark("report", str(again), "--pdf")
    assert {file.stem for file in again.glob("figures/*.pdf")} == {file.stem for file in again.glob("figures/*.svg")}
    for more in (["--latex"], [str(three[0])]):
        done = CliRunner().invoke(app, ["report", str(again), *more, "--pdf"])
        assert isinstance(done.exception, DocumentError)


def test_figure_of_errors_stays_without_all_seeds_errors(three: tuple[Path, str], tmp_path: Path) -> None:
    again = tmp_path / "run"
    shutil.copytree(three[0], again)
    (again / "figures" / "errors.csv").unlink()
    zenpark("report", str(again))
    assert (again / "figures/errors.svg").read_bytes() == (three[0] / "figures/errors.svg").read_bytes()
    assert "Recordings of the others are not kept." in (again / "report.html").read_text()


def test_metrics_of_another_version_are_not_overwritten(three: tuple[Path, str], tmp_path: Path) -> None:
    again = tmp_path / "run"
    shutil.copytree(three[0], again)
    (again / "metrics.json").write_text((again / "metrics.json").read_text().replace('"iae"', '"iae_of_old"'))
    before = (again / "metrics.json").read_bytes()
    done = CliRunner().invoke(app, ["report", str(again)])
    assert done.exit_code != 0
    assert (again / "metrics.json").read_bytes() == before


def test_tables_for_papers_are_over_all_seeds(three: tuple[Path, str]) -> None:
    for form in ("--latex", "--markdown"):
        text = zenpark("report", str(three[0]), form)
        assert "3 seeds" in text
        assert text.count("±") + text.count(r"\pm") > 10
        assert zenpark("report", str(three[0]), str(three[0]), form).count("3 seeds")


def test_console_gives_the_digits_an_interval_supports(three: tuple[Path, str]) -> None:
    lines = three[1].splitlines()
    half = re.search(r"IAE (\d\.\d+) ± (\d\.\d+) m s, ", lines[0])
    assert half is not None
    assert len(half[1]) == len(half[2])
    assert re.search(r"\(ratios: f \d\.\d+ ± \d\.\d+, IAE \d\.\d+ ± \d\.\d+\)", lines[1])


def test_paper_tables_have_a_file_and_chosen_metrics(three: tuple[Path, str], tmp_path: Path) -> None:
    file = tmp_path / "paper" / "t.tex"
    assert zenpark("report", str(three[0]), "--latex", "--out", str(file), "--metrics", "f,iae").strip() == str(file)
    rows = [line for line in file.read_text().splitlines() if line.startswith(("f ", "IAE", "ITAE", "RMSE"))]
    assert [row.split(" [")[0] for row in rows] == ["f", "IAE"]
    done = CliRunner().invoke(app, ["report", str(three[0]), "--latex", "--metrics", "speed"])
    assert "--metrics speed: is not known" in str(done.exception)


def test_sweep_has_figures_and_a_paper_table(three: tuple[Path, str], tmp_path: Path) -> None:
    folder = tmp_path / "swept"
    axis = ["trigger.threshold=0.01,0.05", "seeds=2", "--out", str(folder)]
    said = zenpark("sweep", str(three[0].parent / "short.toml"), *axis)
    assert f"figures: {folder / 'figures'}" in said
    narrow = (folder / "figures" / "pareto_iae.svg").read_text()
    assert zenpark("report", str(folder), "--width", "7.16").strip() == str(folder / "figures")
    assert (folder / "figures" / "pareto_iae.svg").read_text() != narrow
    assert not list((folder / "figures").glob("*.pdf"))
    zenpark("report", str(folder), "--pdf")
    assert {file.stem for file in (folder / "figures").glob("*.pdf")} == {"pareto_iae", "pareto_itae"}
    text = zenpark("report", str(folder), "--latex")
    assert r"\caption{Cases, Two, for three seconds." in text
    assert "event & 0.05 & " in text
    chosen = zenpark("report", str(folder), "--latex", "--metrics", "messages,iae").splitlines()
    assert r"Case & threshold [m] & Messages ratio & IAE ratio \\" in chosen
    wrong = CliRunner().invoke(app, ["report", str(folder), "--latex", "--metrics", "speed"])
    assert "--metrics speed: is not known" in str(wrong.exception)
    assert f"a sweep: `./zenpark report {folder}`" in zenpark("runs", "--past", "--in", str(tmp_path))
    (known,) = json.loads(zenpark("runs", "--past", "--in", str(tmp_path), "--json"))["sweeps"]
    assert (known["folder"], known["cells"], known["seeds"]) == (str(folder), 3, [1, 2])


def test_hazards_of_a_virtual_run_are_printed(three: tuple[Path, str], tmp_path: Path) -> None:
    file, near = str(three[0].parent / "short.toml"), "safety.separation=0.7"
    printed = zenpark("run", file, "--virtual", "--no-report", "--out", str(tmp_path / "x"), "--set", near, "--anyway")
    lines = [line for line in printed.splitlines() if ": hazard " in line]
    assert len(lines) == 6
    assert all("minimum separation" in line for line in lines)
    assert "more, in the recording and the report" in printed
    assert "hazard" not in three[1]


def test_runs_of_several_seeds_are_pooled_to_one(three: tuple[Path, str], tmp_path: Path) -> None:
    file = three[0].parent / "short.toml"
    runs = [str(tmp_path / f"seed{seed}") for seed in (1, 2, 3)]
    for seed, run in enumerate(runs, start=1):
        zenpark("run", str(file), "--virtual", "--seed", str(seed), "--no-report", "--out", run)
    tables = zenpark("report", *runs, "--pool", "--latex", "--metrics", "f,iae")
    assert tables == zenpark("report", str(three[0]), "--latex", "--metrics", "f,iae")
    page = Path(zenpark("report", *runs, "--pool").strip())
    assert page == tmp_path / "seed1-pooled" / "report.html"
    assert f"Of 3 runs together: {', '.join(runs)}." in page.read_text()
    assert "median and range of 3 seeds" in page.read_text()
    twice = CliRunner().invoke(app, ["report", runs[0], runs[0], "--pool"])
    assert "seed 1 is there twice" in str(twice.exception)
    zenpark("run", str(file), "--virtual", "--no-report", "--out", str(tmp_path / "x"), "--set", "duration_s=2.5")
    other = CliRunner().invoke(app, ["report", runs[1], str(tmp_path / "x"), "--pool"])
    assert "differs from" in str(other.exception)


def test_a_comparison_has_the_intervals_of_the_report(three: tuple[Path, str], tmp_path: Path) -> None:
    again = tmp_path / "again"
    shutil.copytree(three[0], again)
    (again / "event.mcap").unlink()  # `clean --recordings` leaves the metrics
    page = tmp_path / "comparison.html"
    lines = zenpark("report", str(three[0]), str(tmp_path), "--out", str(page)).splitlines()
    assert re.fullmatch(rf"B +{re.escape(str(again))} +the same file, seeds and versions", lines[2])
    event = next(line for line in lines if line.startswith("B · event "))
    (reported,) = [line for line in three[1].splitlines() if line.startswith("       event: ")]
    rate, error = re.findall(r"(\d[\d.]* ± [\d.]+)", reported)[:2]
    assert rate in event
    assert error in event
    assert re.search(r" × 0\.\d+ ± 0\.\d+", event)
    assert "Means over 3 seeds ± half-width" in lines[-2]
    assert lines[-1] == str(page)
    assert "Comparison of runs" in page.read_text()
    found = json.loads(zenpark("report", str(three[0]), str(again), "--out", str(page), "--json"))
    assert found["differences"] == {str(again): []}
    figures = found["runs"][0]["cases"]["event"]["iae"]
    assert figures["n"] == 3
    assert figures["ci95"] > 0.0


def test_ratio_has_the_digits_its_interval_supports() -> None:
    assert ratio_words(spread([0.0610, 0.0611, 0.0612])) == "0.0611 ± 0.0002"
    assert ratio_words(spread([1.0784])) == "1.078"


def test_a_run_names_its_replay(three: tuple[Path, str]) -> None:
    assert three[1].splitlines()[-1] == f"replay in the browser: ./zenpark view {three[0]}"


@pytest.mark.parametrize(("made", "kept"), [([], "nothing is kept"), (["event"], "kept is seed 1 of event")])
def test_interrupted_run_over_seeds_reports_what_is_kept(
    made: list[str], kept: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def interrupted(*_: object, folder: Path, **__: object) -> None:
        for case in made:
            (folder / f"{case}.mcap").touch()
        raise KeyboardInterrupt

    monkeypatch.setattr("experiments.run.simulate_seeds", interrupted)
    (tmp_path / "short.toml").write_text(SHORT)
    options = ["--virtual", "--seeds", "60", "--out", str(tmp_path / "run")]
    done = CliRunner().invoke(app, ["run", str(tmp_path / "short.toml"), *options])
    assert done.exit_code != 0
    assert f"interrupted: {kept}" in done.stderr
    assert "`./zenpark sweep` keeps every seed" in done.stderr


def _measured(*acquired: float | None) -> Any:
    """One case of two robots: when each acquired, None in `mean` if one did not."""
    mean = None if None in acquired else 1.0
    robots = [SimpleNamespace(robot=f"R{k}", acquired_s=when) for k, when in enumerate(acquired)]
    return SimpleNamespace(mean={"acquired_s": mean}, robots=robots, leaders=(), died=())


@pytest.mark.parametrize(
    ("runs", "words"),
    [
        ([_measured(5.4, 5.5)] * 2, "acquired after 7.8 s (mean)"),
        ([_measured(5.4, 5.5), _measured(5.4, None)], "acquired after 7.8 s (mean of 1 of 2 seeds, the others never)"),
        ([_measured(5.4, None)], "not acquired by all (1 of 2 robots were there)"),
        ([_measured(5.4, None)] * 2, "not acquired by all in any of 2 seeds (2 of 4 robots were there)"),
    ],
)
def test_seeds_that_never_acquire_are_counted(runs: list[Any], words: str) -> None:
    assert _acquired("7.8", runs) == words


def test_a_spoiled_run_is_not_compared(three: tuple[Path, str], tmp_path: Path) -> None:
    file, out = str(three[0].parent / "short.toml"), str(tmp_path / "x")
    options = ["--virtual", "--no-report", "--out", out, "--set", "cases.event.safety.battery_low=0.999999", "--anyway"]
    done = CliRunner().invoke(app, ["run", file, *options])
    assert done.exit_code == 1
    assert "✗ Spoiled, and compared with nothing: event: robots failed." in done.stdout
    assert "ratios" not in done.stdout
    compared = zenpark("report", str(three[0]), out, "--out", str(tmp_path / "comparison.html"))
    assert "×" not in next(line for line in compared.splitlines() if line.startswith("B · event "))
    assert "Spoiled, and compared with nothing: B · event: " in compared
    assert "robots failed" in zenpark("runs", "--past", "--in", out)
    pooled = CliRunner().invoke(app, ["report", out, str(three[0]), "--pool"])
    assert "is no whole run that nothing spoiled" in str(pooled.exception)


def test_an_index_of_files_is_not_a_word() -> None:
    with pytest.raises(DocumentError, match="did you mean 'acquired'"):
        known_words("--metrics", ["acquired_s"], ["f", "iae", "acquired"])
