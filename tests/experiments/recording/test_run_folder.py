"""Folders of runs, their list and their removal: nothing that is in use, no link's end, no folder that is no run's."""

import errno
import shutil
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from unittest.mock import Mock

import msgspec
import pytest

from agents.body.interface import Disturbance, Jitter
from experiments import run
from experiments.definition.experiment import ChannelTable, LinkChannelTable, Start
from experiments.definition.plan import Plan
from experiments.file import document
from experiments.file.problems import DocumentError
from experiments.recording import cleaning, run_folder
from experiments.recording.run_folder import RunOrigin
from experiments.recording.version import provenance
from tests.commands import invoke
from tests.small import pair


def test_runs_of_the_same_second_have_own_folders(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    read = document.load("triangle")
    with ThreadPoolExecutor(8) as pool:
        folders = {*pool.map(lambda _: run_folder.new_folder(read, None), range(24))}
    assert len([folder for folder in folders if folder.is_dir()]) == 24
    with pytest.raises(DocumentError):
        run_folder.check_folder("x" * 300)  # longer than a file system takes


def test_folder_without_a_run_is_removed(tmp_path):
    read = document.load("triangle")
    _, failed, flown = folders = [run_folder.new_folder(read, str(tmp_path / name)) for name in "abc"]
    for folder in folders:
        read.keep(folder / run_folder.SOURCE)
    (failed / "logs").mkdir()
    (failed / "logs" / "router.log").write_text("no such port")
    (flown / "event.mcap").touch()
    for folder in folders:
        run_folder.remove_unused(folder)
    assert sorted(tmp_path.iterdir()) == [failed, flown]


@pytest.mark.parametrize(
    ("change", "says"),
    [
        ("channel.delay_s=1e9", "must be a number <= 60"),
        ("duration_s=0.001", "less than two samples"),
        ("rates.state_hz=0.01", "less than two samples"),
        ("seed=1", "fit into memory"),
    ],
)
def test_numbers_that_no_run_can_have(change, says):
    with pytest.raises(DocumentError, match=says):
        run.simulate_seeds(document.load("triangle", change), range(100_000))


@pytest.mark.parametrize(
    ("parts", "chance"),
    [
        ({"disturbance": {"all": Disturbance(latency_s=0.1)}}, False),
        ({"disturbance": {"all": Disturbance(position_sigma=0.001)}}, True),
        ({"disturbance": {"A": Disturbance(hover_jitter=Jitter(0.01))}}, True),
        ({"disturbance": {"khepera4": Disturbance(odometry_drift=0.001)}}, True),
        ({"start": Start(scatter=0.1)}, True),
        ({"channel": ChannelTable(loss=0.1)}, True),
        ({"channel": ChannelTable(links={"A > B": LinkChannelTable(jitter_s=0.1)})}, True),
    ],
)
def test_whether_seeds_change_anything(parts, chance):
    assert Plan(pair(**parts)).uses_chance is chance


def kept(folder, *, seed=1, text='title = "Two"\n[trigger]\nkind = "periodic"\n', lost=0, **origin):
    """The folder of a run of an hour with two seeds, without a recording that could be read."""
    folder.mkdir(parents=True)
    (folder / run_folder.SOURCE).write_text(text)
    run_folder.keep_origin(folder, RunOrigin(title="Two", file="two.toml", **{"begun": 1e9, **origin}))
    case = {"case": "event", "mean": {"f_hz": 10.0 * seed, "iae": 1.5, "rmse": None}, "duration_s": 1800.0}
    figures = [{**case, "seed": seed, "lost": lost}, {**case, "seed": seed + 1}]
    (folder / "metrics.json").write_bytes(msgspec.json.encode(figures))
    (folder / "event.mcap").write_bytes(b"0" * 1000)
    return folder


def test_past_runs_with_their_figures_sizes_and_tags(tmp_path):
    kept(tmp_path / "later", begun=2e9, tags=["paper"])
    kept(tmp_path / "earlier", virtual=True)
    (tmp_path / "no run").mkdir()
    earlier, later = run_folder.past_runs([tmp_path])
    found = (*(Path(run.folder).name for run in (earlier, later)), earlier.seeds, earlier.recorded)
    assert (*found, earlier.megabytes > 0.001) == ("earlier", "later", [1, 2], True, True)
    unknown = {1: None, 2: None}
    assert earlier.cases == {"event": {"f_hz": {1: 10.0, 2: 10.0}, "iae": {1: 1.5, 2: 1.5}, "rmse": unknown}}
    asked = (["paper"], ["EVENT", "two"], ["pape"], ["paper", "other"])
    assert [later.matches(words) for words in asked] == [True, True, False, False]


def test_damaged_folders_are_listed_nevertheless(tmp_path):
    folder = kept(tmp_path / "damaged")
    before = run_folder.past_runs([tmp_path])
    (folder / "gone.mcap").symlink_to(tmp_path / "nowhere")
    assert run_folder.past_runs([tmp_path]) == before
    for begun in (1e300, 1e18, -5.0):
        run_folder.keep_origin(folder, RunOrigin(title="Two", begun=begun))
        (run,) = run_folder.past_runs([tmp_path])
        assert run.made == (folder / run_folder.SOURCE).stat().st_mtime
        invoke("runs", "--past", "--in", tmp_path)
    for name in ("run.json", "metrics.json"):
        (folder / name).write_text("[1, 2")
    (run,) = run_folder.past_runs([tmp_path])
    assert (run.cases, run.origin) == ({}, RunOrigin())


def test_how_runs_differ(tmp_path):
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


def test_past_runs_on_the_command_line(tmp_path):
    for k, lost in enumerate((0, 9, 0, 0)):
        kept(tmp_path / str(k), begun=1e9 + k, lost=lost, tags=["paper"] if k == 0 else [])
    kept(tmp_path / "virtual", begun=2e9, lost=5, virtual=True)
    past, virtual, paper = (
        invoke("runs", *words, "--in", tmp_path).stdout for words in (["--past"], ["virtual"], ["paper", "--json"])
    )
    _, first, second, *_, losses, _ = past.splitlines()
    assert [line.split()[2] for line in (first, second)] == [str(tmp_path / "0"), str(tmp_path / "1")]
    assert first.endswith("paper")
    assert losses == "real time: 4 h in 4 runs; 9 poses lost, 2.25 per hour; the last 2 h without loss"
    assert ("real time" in virtual, len(msgspec.json.decode(paper)["runs"])) == (False, 1)


def test_clean_removes_the_named_but_nothing_tagged(tmp_path):
    a, b, _ = kept(tmp_path / "a", tags=["paper"]), kept(tmp_path / "b"), kept(tmp_path / "c")
    (tmp_path / "mine").mkdir()
    where = ["--in", tmp_path]
    invoke("clean", *where, code=2)
    assert f"would remove {b}" in invoke("clean", "two", *where).stdout
    assert b.exists()
    invoke("clean", "b", "--recordings", "--yes", *where)
    assert sorted(file.name for file in b.iterdir()) == ["experiment.toml", "metrics.json", "run.json"]
    invoke("clean", "--older", "1", "--yes", *where)
    assert sorted(tmp_path.iterdir()) == [a, tmp_path / "mine"]
    invoke("clean", "paper", "--tagged", "--yes", *where)
    assert sorted(tmp_path.iterdir()) == [tmp_path / "mine"]


def clean(folder, *words, code=0):
    return invoke("clean", "--older", "0", "--in", folder, *words, code=code).output


def test_runs_in_use_stay(tmp_path):
    used, over = kept(tmp_path / "used"), kept(tmp_path / "over", ended=2.0)
    with cleaning.using(used):
        for words in ([], ["--yes"], ["--yes", "--recordings"]):
            assert f"{used} is in use: it stays" in clean(tmp_path, *words)
    assert ((used / "event.mcap").exists(), over.exists()) == (True, False)
    with cleaning.locked(used, cleaning.fcntl.LOCK_EX), pytest.raises(cleaning.InUse):
        cleaning.remove(used)
    with cleaning.using(kept(used / "inner")):
        clean(tmp_path, "--yes")
    assert (used / "event.mcap").exists(), "a run inside protects it"
    clean(tmp_path, "--yes")
    assert not used.exists()


def test_foreign_folders_and_ends_of_links_stay(tmp_path):
    thesis, project = tmp_path / "thesis", kept(tmp_path / "project")
    thesis.mkdir()
    for name in (run_folder.SOURCE, "data.mcap"):
        (thesis / name).touch()
    assert "runs: 0" in clean(project, "--yes"), "the given folder itself"
    folder = kept(tmp_path / "runs" / "a", ended=2.0)
    (tmp_path / "runs" / "link").symlink_to(project)
    (folder / "logs").symlink_to(thesis)
    clean(tmp_path / "runs", "--yes", "--recordings")
    clean(tmp_path / "runs", "--yes")
    assert [path.name for path in (tmp_path / "runs").iterdir()] == ["link"]
    assert "runs: 0" in clean(thesis.parent / "runs", "--yes")
    clean(tmp_path, "--yes")
    assert {path.name for path in thesis.iterdir()} == {run_folder.SOURCE, "data.mcap"}


def test_half_removed_and_endless_runs_are_runs(tmp_path, monkeypatch):
    folder = kept(tmp_path / "run", ended=2.0)
    (folder / "logs").mkdir()
    monkeypatch.setattr(shutil, "rmtree", Mock(side_effect=OSError(errno.EACCES, "Permission denied")))
    assert "cannot be removed: Permission denied" in clean(tmp_path, "--yes", code=1)
    assert {run_folder.SOURCE, run_folder.ORIGIN} <= {path.name for path in folder.iterdir()}
    monkeypatch.undo()
    endless = kept(tmp_path / "endless")
    monkeypatch.setattr(cleaning.fcntl, "flock", Mock(side_effect=OSError(errno.ENOLCK, "No locks available")))
    clean(tmp_path, "--yes")
    assert [*tmp_path.iterdir()] == [endless], "without locks it may be in use"
