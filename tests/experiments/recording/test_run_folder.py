"""Folders of runs, their list and their removal: nothing that is in use, no link's end, no folder that is no run's."""

import errno
import shutil
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import msgspec
import pytest

from agents.body.interface import Disturbance, Jitter
from experiments import run
from experiments.definition.experiment import ChannelTable, LinkChannelTable, Start
from experiments.definition.plan import Plan
from experiments.file import document
from experiments.file.problems import DocumentError
from experiments.recording import cleaning, run_folder, version
from experiments.recording.run_folder import RunOrigin
from experiments.recording.version import provenance
from tests.commands import invoke
from tests.small import pair


def test_runs_of_the_same_second_have_own_folders(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    read = document.load("triangle")
    with ThreadPoolExecutor(8) as pool:
        folders = {*pool.map(lambda _: run_folder.new_folder(read, None), range(24))}
    assert len(folders) == 24
    assert all(folder.is_dir() for folder in folders)


def test_folder_that_cannot_be_looked_into_is_refused():
    with pytest.raises(DocumentError):
        run_folder.check_folder("x" * 300)  # longer than a file system takes


def test_machine_that_tells_no_memory_has_a_provenance(monkeypatch):
    def unknown(_):
        raise ValueError("unrecognized configuration name")

    monkeypatch.setattr(version.os, "sysconf", unknown)
    assert provenance().memory_gb == 0.0


def test_folder_without_a_run_is_removed(tmp_path):
    read = document.load("triangle")
    empty, failed, flown = folders = [run_folder.new_folder(read, str(tmp_path / name)) for name in "abc"]
    for folder in folders:
        read.keep(folder / run_folder.SOURCE)
    (failed / "logs").mkdir()
    (failed / "logs" / "router.log").write_text("no such port")
    (flown / "event.mcap").touch()
    for folder in folders:
        run_folder.remove_unused(folder)
    assert sorted(tmp_path.iterdir()) == [failed, flown]
    assert not empty.exists()


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
def test_numbers_that_no_run_can_have(change, says):
    with pytest.raises(DocumentError, match=says):
        document.load("triangle", change)


def test_virtual_run_must_fit_into_memory():
    with pytest.raises(DocumentError, match="fit into memory"):
        run.simulate_seeds(document.load("triangle"), range(100_000))


@pytest.mark.parametrize(
    ("parts", "chance"),
    [
        ({}, False),
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


PERIODIC = 'title = "Two"\n[trigger]\nkind = "periodic"\n'


def kept(folder, *, seed=1, text=PERIODIC, lost=0, **origin):
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


def test_folder_with_damaged_files_is_listed_without_figures(tmp_path):
    folder = kept(tmp_path / "damaged")
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
    a, b = kept(tmp_path / "a", tags=["paper"]), kept(tmp_path / "b", seed=3)
    lines = invoke("runs", "--past", "--in", tmp_path).stdout.splitlines()
    assert [line.split()[2] for line in lines[1:3]] == [str(a), str(b)]
    assert lines[1].endswith("paper")
    assert len(msgspec.json.decode(invoke("runs", "paper", "--in", tmp_path, "--json").stdout)["runs"]) == 1


def test_past_runs_tell_losses_per_hour(tmp_path):
    for k, lost in enumerate((0, 9, 0, 0)):
        kept(tmp_path / str(k), begun=1e9 + k, lost=lost)
    kept(tmp_path / "virtual", begun=2e9, lost=5, virtual=True)
    *_, line, _ = invoke("runs", "--past", "--in", tmp_path).stdout.splitlines()
    assert line == "real time: 4 h in 4 runs; 9 poses lost, 2.25 per hour; the last 2 h without loss"
    assert "real time" not in invoke("runs", "virtual", "--in", tmp_path).stdout


def test_clean_removes_the_named_but_nothing_tagged(tmp_path):
    a, b, c = kept(tmp_path / "a", tags=["paper"]), kept(tmp_path / "b"), kept(tmp_path / "c")
    (tmp_path / "mine").mkdir()
    where = ["--in", tmp_path]
    invoke("clean", *where, code=2)
    assert f"would remove {b}" in invoke("clean", "two", *where).stdout
    assert b.exists()
    invoke("clean", "b", "--recordings", "--yes", *where)
    assert sorted(file.name for file in b.iterdir()) == ["experiment.toml", "metrics.json", "run.json"]
    invoke("clean", "--older", "1", "--yes", *where)
    assert sorted(tmp_path.iterdir()) == [a, tmp_path / "mine"]
    assert not c.exists()
    invoke("clean", "paper", "--tagged", "--yes", *where)
    assert sorted(tmp_path.iterdir()) == [tmp_path / "mine"]


def clean(folder, *words):
    return invoke("clean", "--older", "0", "--in", folder, *words).output


def test_runs_in_use_stay(tmp_path):
    used, over = kept(tmp_path / "used"), kept(tmp_path / "over", ended=2.0)
    with cleaning.using(used):
        for words in ([], ["--yes"], ["--yes", "--recordings"]):
            assert f"{used} is in use: it stays" in clean(tmp_path, *words)
    assert (used / "event.mcap").exists()
    assert not over.exists()
    clean(tmp_path, "--yes")
    assert not used.exists()


def test_runs_inside_runs_protect_them(tmp_path):
    outer = kept(tmp_path / "outer")
    with cleaning.using(kept(outer / "inner")):
        clean(tmp_path, "--yes")
    assert (outer / "event.mcap").exists()


def test_two_removals_do_not_meet(tmp_path):
    folder = kept(tmp_path / "run")
    with cleaning.locked(folder, cleaning.fcntl.LOCK_EX), pytest.raises(cleaning.InUse):
        cleaning.remove(folder)


def test_given_folder_itself_stays(tmp_path):
    project = kept(tmp_path / "project")
    assert "runs: 0" in clean(project, "--yes")
    assert (project / run_folder.SOURCE).exists()


def test_foreign_folders_stay(tmp_path):
    for name in (run_folder.SOURCE, "data.mcap"):
        (tmp_path / "thesis").mkdir(exist_ok=True)
        (tmp_path / "thesis" / name).touch()
    (tmp_path / "link").symlink_to(kept(tmp_path / "elsewhere" / "run"))
    assert "runs: 0" in clean(tmp_path, "--yes")
    assert {path.name for path in tmp_path.iterdir()} == {"thesis", "link", "elsewhere"}


def test_ends_of_links_stay(tmp_path):
    archive, folder = tmp_path / "archive", kept(tmp_path / "runs" / "a", ended=2.0)
    archive.mkdir()
    (archive / "kept").touch()
    (folder / "logs").symlink_to(archive)
    clean(tmp_path / "runs", "--yes", "--recordings")
    clean(tmp_path / "runs", "--yes")
    assert (archive / "kept").exists()
    assert not folder.exists()


def test_half_removed_runs_are_still_runs(tmp_path, monkeypatch):
    folder = kept(tmp_path / "run", ended=2.0)
    (folder / "logs").mkdir()

    def refuse(part):
        raise OSError(errno.EACCES, "Permission denied", str(part))

    monkeypatch.setattr(shutil, "rmtree", refuse)
    done = invoke("clean", "--older", "0", "--yes", "--in", tmp_path, code=1)
    assert "cannot be removed: Permission denied" in done.output
    assert {run_folder.SOURCE, run_folder.ORIGIN} <= {path.name for path in folder.iterdir()}
    monkeypatch.undo()
    clean(tmp_path, "--yes")
    assert not folder.exists()


def test_endless_runs_stay_without_locks(tmp_path, monkeypatch):
    endless, ended = kept(tmp_path / "endless"), kept(tmp_path / "ended", ended=2.0)

    def refuse(*_):
        raise OSError(errno.ENOLCK, "No locks available")

    monkeypatch.setattr(cleaning.fcntl, "flock", refuse)
    clean(tmp_path, "--yes")
    assert (endless.exists(), ended.exists()) == (True, False)


def test_dangling_links_count_nothing(tmp_path):
    folder = kept(tmp_path / "run")
    before = run_folder.past_runs([tmp_path])
    (folder / "gone.mcap").symlink_to(tmp_path / "nowhere")
    assert run_folder.past_runs([tmp_path]) == before


@pytest.mark.parametrize("begun", [1e300, -1e300, 1e18, -5.0])
def test_absurd_times_are_no_error(begun, tmp_path):
    kept(tmp_path / "run", begun=begun)
    (run,) = run_folder.past_runs([tmp_path])
    assert run.made == (tmp_path / "run" / run_folder.SOURCE).stat().st_mtime
    invoke("runs", "--past", "--in", tmp_path)
