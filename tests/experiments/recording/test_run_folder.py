"""Folders of runs, and numbers that no run can have."""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import msgspec
import pytest
from typer.testing import CliRunner

from agents.body.interface import Disturbance, Jitter
from experiments import run
from experiments.definition.experiment import ChannelTable, LinkChannelTable, Start
from experiments.definition.plan import Plan
from experiments.file import document
from experiments.file.problems import DocumentError
from experiments.recording import run_folder
from experiments.recording.run_folder import RunOrigin
from experiments.recording.version import provenance
from tests.agents.few import pair
from tools.main import app


def test_runs_of_the_same_second_have_own_folders(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    read = document.load("triangle")
    with ThreadPoolExecutor(8) as pool:
        folders = list(pool.map(lambda _: run_folder.new_folder(read, None), range(24)))
    assert len({*folders}) == 24
    assert all(folder.is_dir() for folder in folders)


def test_folder_without_a_run_is_removed(tmp_path: Path) -> None:
    read = document.load("triangle")
    empty, failed, flown = (run_folder.new_folder(read, str(tmp_path / name)) for name in ("empty", "failed", "flown"))
    for folder in (empty, failed, flown):
        read.keep(folder / run_folder.SOURCE)
    (failed / "logs").mkdir()
    (failed / "logs" / "router.log").write_text("no such port")
    (flown / "event.mcap").touch()
    for folder in (empty, failed, flown):
        run_folder.remove_unused(folder)
    assert sorted(tmp_path.iterdir()) == [failed, flown]


@pytest.mark.parametrize(
    ("change", "says"),
    [
        ("rates.body_hz=1e9", "must be a number <= 2000"),
        ("rates.state_hz=1e9", "must be a number <= 2000"),
        ("disturbance.all.latency_s=1e9", "must be a number <= 10"),
        ("channel.delay_s=1e9", "must be a number <= 60"),
        ("duration_s=0.001", "less than two samples"),
        ("rates.state_hz=0.01", "less than two samples"),
    ],
)
def test_numbers_that_no_run_can_have(change: str, says: str) -> None:
    with pytest.raises(DocumentError, match=says):
        document.load("triangle", change)


def test_virtual_run_must_fit_into_memory() -> None:
    with pytest.raises(DocumentError, match="fit into memory"):
        run.simulate_seeds(document.load("triangle"), range(100_000))


def test_whether_seeds_change_anything() -> None:
    bare = pair()
    random = [
        {"disturbance": {"all": Disturbance(position_sigma=0.001)}},
        {"disturbance": {"A": Disturbance(hover_jitter=Jitter(0.01))}},
        {"disturbance": {"khepera4": Disturbance(odometry_drift=0.001)}},
        {"start": Start(scatter=0.1)},
        {"channel": ChannelTable(loss=0.1)},
        {"channel": ChannelTable(links={"A > B": LinkChannelTable(jitter_s=0.1)})},
    ]
    assert not Plan(bare).uses_chance
    assert not Plan(msgspec.structs.replace(bare, disturbance={"all": Disturbance(latency_s=0.1)})).uses_chance
    for parts in random:
        assert Plan(msgspec.structs.replace(bare, **parts)).uses_chance


PERIODIC = 'title = "Two"\n[trigger]\nkind = "periodic"\n'


def kept(folder: Path, *, seed: int = 1, text: str = PERIODIC, lost: int = 0, **origin) -> Path:
    """The folder of a run of an hour with two seeds, without a recording that could be read."""
    folder.mkdir(parents=True)
    (folder / run_folder.SOURCE).write_text(text)
    run_folder.keep_origin(folder, RunOrigin(title="Two", file="two.toml", **{"begun": 1e9, **origin}))
    mean = {"f_hz": 10.0 * seed, "iae": 1.5, "rmse": None}
    each = {"case": "event", "mean": mean, "duration_s": 1800.0}
    figures = [{**each, "seed": seed, "lost": lost}, {**each, "seed": seed + 1}]
    (folder / "metrics.json").write_bytes(msgspec.json.encode(figures))
    (folder / "event.mcap").write_bytes(b"0" * 1000)
    return folder


def test_past_runs_with_their_figures_sizes_and_tags(tmp_path: Path) -> None:
    kept(tmp_path / "later", begun=2e9, tags=["paper"])
    kept(tmp_path / "earlier", virtual=True)
    (tmp_path / "no run").mkdir()
    (tmp_path / "no run" / "notes.txt").write_text("mine")
    earlier, later = run_folder.past_runs([tmp_path])
    assert [Path(run.folder).name for run in (earlier, later)] == ["earlier", "later"]
    unknown = {1: None, 2: None}
    both = {"f_hz": {1: 10.0, 2: 10.0}, "iae": {1: 1.5, 2: 1.5}, "rmse": unknown}
    assert earlier.cases == {"event": both}
    assert (earlier.seeds, earlier.recorded, earlier.megabytes > 0.001) == ([1, 2], True, True)
    assert [later.matches(words) for words in (["paper"], ["EVENT", "two"], ["pape"], ["paper", "other"])] == [
        True, True, False, False,
    ]  # fmt: skip


def test_folder_with_damaged_files_is_listed_without_figures(tmp_path: Path) -> None:
    folder = kept(tmp_path / "damaged")
    for name in ("run.json", "metrics.json"):
        (folder / name).write_text("[1, 2")
    (run,) = run_folder.past_runs([tmp_path])
    assert (run.cases, run.origin) == ({}, RunOrigin())


def test_how_runs_differ(tmp_path: Path) -> None:
    made = provenance()
    other = msgspec.structs.replace(made, code="0" * 64)
    text = 'title = "Two"\n[trigger]\nkind = "send-on-delta"\nthreshold = 0.01\n'
    kept(tmp_path / "a", made_by=made)
    kept(tmp_path / "b", made_by=made, begun=2e9)
    kept(tmp_path / "c", made_by=other, begun=3e9, text=text, seed=5, changes=["safety.margin=0.1"], bodies="world")
    a, b, c = run_folder.past_runs([tmp_path])
    assert run_folder.differences(a, b) == []
    assert run_folder.differences(a, c) == [
        "trigger.kind periodic → send-on-delta",
        "trigger.threshold - → 0.01",
        "bodies: - → world",
        "changes: - → safety.margin=0.1",
        "seeds: 1, 2 → 5, 6",
        f"made with code 00000000, not {made.code[:8]}",
    ]


def zenpark(*words: str):
    return CliRunner().invoke(app, [*words])


def test_past_runs_on_the_command_line(tmp_path: Path) -> None:
    a, b = kept(tmp_path / "a", tags=["paper"]), kept(tmp_path / "b", seed=3)
    lines = zenpark("runs", "--past", "--in", str(tmp_path)).stdout.splitlines()
    assert [line.split()[2] for line in lines[1:3]] == [str(a), str(b)]
    assert lines[1].endswith("paper")
    assert len(msgspec.json.decode(zenpark("runs", "paper", "--in", str(tmp_path), "--json").stdout)["runs"]) == 1


def test_past_runs_tell_losses_per_hour(tmp_path: Path) -> None:
    for k, lost in enumerate((0, 9, 0, 0)):
        kept(tmp_path / str(k), begun=1e9 + k, lost=lost)
    kept(tmp_path / "virtual", begun=2e9, lost=5, virtual=True)
    *_, line, _ = zenpark("runs", "--past", "--in", str(tmp_path)).stdout.splitlines()
    assert line == "real time: 4 h in 4 runs; 9 poses lost, 2.25 per hour; the last 2 h without loss"
    assert "real time" not in zenpark("runs", "virtual", "--in", str(tmp_path)).stdout


def test_clean_removes_the_named_but_nothing_tagged(tmp_path: Path) -> None:
    a, b, c = kept(tmp_path / "a", tags=["paper"]), kept(tmp_path / "b"), kept(tmp_path / "c")
    (tmp_path / "mine").mkdir()
    where = ["--in", str(tmp_path)]
    assert zenpark("clean", *where).exit_code == 2
    assert f"would remove {b}" in zenpark("clean", "two", *where).stdout
    assert b.exists()
    assert zenpark("clean", "b", "--recordings", "--yes", *where).exit_code == 0
    assert sorted(file.name for file in b.iterdir()) == ["experiment.toml", "metrics.json", "run.json"]
    assert zenpark("clean", "--older", "1", "--yes", *where).exit_code == 0
    assert sorted(tmp_path.iterdir()) == [a, tmp_path / "mine"]
    assert not c.exists()
    assert zenpark("clean", "paper", "--tagged", "--yes", *where).exit_code == 0
    assert sorted(tmp_path.iterdir()) == [tmp_path / "mine"]
