"""Folders of runs, and numbers that no run can have."""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import msgspec
import pytest

from agents.body.interface import Disturbance, Jitter
from experiments import run
from experiments.definition.experiment import Channel, LinkChannel, Start
from experiments.definition.plan import Plan
from experiments.file import document
from experiments.file.problems import DocumentError
from experiments.recording import run_folder
from tests.agents.few import pair


def test_runs_that_begin_in_the_same_second_have_folders_of_their_own(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    read = document.load("triangle")
    with ThreadPoolExecutor(8) as pool:
        folders = list(pool.map(lambda _: run_folder.new_folder(read, None), range(24)))
    assert len({*folders}) == 24
    assert all(folder.is_dir() for folder in folders)


def test_a_folder_in_which_nothing_was_run_is_removed(tmp_path: Path) -> None:
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


def test_a_run_in_virtual_time_must_fit_into_memory() -> None:
    with pytest.raises(DocumentError, match="fit into memory"):
        run.simulate_seeds(document.load("triangle"), range(100_000))


def test_whether_seeds_change_anything() -> None:
    bare = pair()
    random = [
        {"disturbance": {"all": Disturbance(position_sigma=0.001)}},
        {"disturbance": {"A": Disturbance(hover_jitter=Jitter(0.01))}},
        {"disturbance": {"khepera4": Disturbance(odometry_drift=0.001)}},
        {"start": Start(scatter=0.1)},
        {"channel": Channel(loss=0.1)},
        {"channel": Channel(links={"A > B": LinkChannel(jitter_s=0.1)})},
    ]
    assert not Plan(bare).uses_chance
    assert not Plan(msgspec.structs.replace(bare, disturbance={"all": Disturbance(latency_s=0.1)})).uses_chance
    for parts in random:
        assert Plan(msgspec.structs.replace(bare, **parts)).uses_chance
