"""Removal of past runs: nothing that is in use, no link's end, and no folder that is no run's."""

from __future__ import annotations

import errno
import shutil
from pathlib import Path

import pytest
from typer.testing import CliRunner

from experiments.recording import cleaning
from experiments.recording.run_folder import ORIGIN, SOURCE, RunOrigin, keep_origin, past_runs
from tools.main import app


def past(folder: Path, **known: object) -> Path:
    """Folder of a run."""
    (folder / "logs").mkdir(parents=True)
    for name in (SOURCE, "event.mcap", "report.html"):
        (folder / name).write_text("title = 't'")
    keep_origin(folder, RunOrigin(begun=1.0, **known))
    return folder


def clean(folder: Path, *words: str) -> str:
    done = CliRunner().invoke(app, ["clean", "--older", "0", "--in", str(folder), *words])
    assert done.exit_code == 0, done.output
    return done.output


def test_runs_in_use_stay(tmp_path: Path) -> None:
    used, over = past(tmp_path / "used"), past(tmp_path / "over", ended=2.0)
    with cleaning.using(used):
        for words in ([], ["--yes"], ["--yes", "--recordings"]):
            assert f"{used} is in use: it stays" in clean(tmp_path, *words)
    assert (used / "event.mcap").exists()
    assert not over.exists()
    clean(tmp_path, "--yes")
    assert not used.exists()


def test_runs_inside_runs_protect_them(tmp_path: Path) -> None:
    outer = past(tmp_path / "outer")
    inner = past(outer / "inner")
    with cleaning.using(inner):
        clean(tmp_path, "--yes")
    assert (outer / "event.mcap").exists()


def test_two_removals_do_not_meet(tmp_path: Path) -> None:
    folder = past(tmp_path / "run")
    with cleaning.locked(folder, cleaning.fcntl.LOCK_EX), pytest.raises(cleaning.InUse):
        cleaning.remove(folder)


def test_given_folder_itself_stays(tmp_path: Path) -> None:
    project = past(tmp_path / "project")
    assert "runs: 0" in clean(project, "--yes")
    assert (project / SOURCE).exists()


def test_foreign_folders_stay(tmp_path: Path) -> None:
    for name in (SOURCE, "data.mcap"):
        (tmp_path / "thesis").mkdir(exist_ok=True)
        (tmp_path / "thesis" / name).touch()
    (tmp_path / "link").symlink_to(past(tmp_path / "elsewhere" / "run"))
    assert "runs: 0" in clean(tmp_path, "--yes")
    assert {path.name for path in tmp_path.iterdir()} == {"thesis", "link", "elsewhere"}


def test_ends_of_links_stay(tmp_path: Path) -> None:
    archive = tmp_path / "archive"
    archive.mkdir()
    (archive / "kept").touch()
    for option in (["--recordings"], []):
        folder = past(tmp_path / "runs" / "a", ended=2.0) if option else tmp_path / "runs" / "a"
        if option:
            (folder / "logs").rmdir()
            (folder / "logs").symlink_to(archive)
        clean(tmp_path / "runs", "--yes", *option)
    assert (archive / "kept").exists()
    assert not (tmp_path / "runs" / "a").exists()


def test_half_removed_runs_are_still_runs(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    folder = past(tmp_path / "run", ended=2.0)

    def refuse(part: Path) -> None:
        raise OSError(errno.EACCES, "Permission denied", str(part))

    monkeypatch.setattr(shutil, "rmtree", refuse)
    done = CliRunner().invoke(app, ["clean", "--older", "0", "--yes", "--in", str(tmp_path)])
    assert done.exit_code == 1
    assert "cannot be removed: Permission denied" in done.output
    assert {SOURCE, ORIGIN} <= {path.name for path in folder.iterdir()}
    monkeypatch.undo()
    clean(tmp_path, "--yes")
    assert not folder.exists()


def test_endless_runs_stay_without_locks(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    endless, ended = past(tmp_path / "endless"), past(tmp_path / "ended", ended=2.0)

    def refuse(*_: object) -> None:
        raise OSError(errno.ENOLCK, "No locks available")

    monkeypatch.setattr(cleaning.fcntl, "flock", refuse)
    clean(tmp_path, "--yes")
    assert (endless.exists(), ended.exists()) == (True, False)


def test_dangling_links_count_nothing(tmp_path: Path) -> None:
    folder = past(tmp_path / "run")
    (folder / "gone.mcap").symlink_to(tmp_path / "nowhere")
    (run,) = past_runs([tmp_path])
    assert run.megabytes < 1e-3


@pytest.mark.parametrize("begun", [1e300, -1e300, 1e18, -5.0])
def test_absurd_times_are_no_error(begun: float, tmp_path: Path) -> None:
    keep_origin(past(tmp_path / "run"), RunOrigin(begun=begun))
    (run,) = past_runs([tmp_path])
    assert run.made == (tmp_path / "run" / SOURCE).stat().st_mtime
    assert CliRunner().invoke(app, ["runs", "--past", "--in", str(tmp_path)]).exit_code == 0
