"""Bundles: a run in virtual time is repeated from one to the last bit; damaged and foreign archives are refused."""

from __future__ import annotations

import errno
import json
import shutil
import zipfile
from pathlib import Path

import msgspec
import pytest
from typer.testing import CliRunner

from experiments.recording import bundle, run_folder, version
from experiments.recording.reader import RecordingError, Records
from tools.main import app

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


def zenpark(*words: str):
    return CliRunner().invoke(app, [*words])


@pytest.fixture(scope="module")
def flown(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Folder of a run with two seeds, one of two cases and a changed value."""
    folder = tmp_path_factory.mktemp("bundle")
    (folder / "short.toml").write_text(SHORT)
    options = ["--virtual", "--case", "event", "--seed", "5", "--seeds", "2", "--set", "safety.margin=0.1"]
    done = zenpark("run", str(folder / "short.toml"), *options, "--tag", "demo", "--out", str(folder / "run"))
    assert done.exit_code == 0, done.output
    done = zenpark("export", str(folder / "run"), "--bundle")
    assert done.exit_code == 0, done.output
    return folder


def test_run_records_how_where_and_with_what(flown: Path) -> None:
    origin = run_folder.read_origin(flown / "run")
    assert origin is not None
    assert origin.command.startswith(
        f"./zenpark run {flown / 'short.toml'} --virtual --case event --set 'safety.margin"
    )
    assert (origin.seeds, origin.cases, origin.tags) == (2, ["event"], ["demo"])
    assert origin.ended is not None
    assert origin.ended >= origin.begun
    made = origin.made_by
    assert made is not None
    assert (made.code, made.packages["numpy"]) == (version.digest(), version.provenance().packages["numpy"])
    records = Records(flown / "run" / "event.mcap")
    list(records.messages())
    about = records.metadata[0].metadata
    assert (about["code"], about["numpy"], about["host"]) == (made.code, made.packages["numpy"], made.host)
    foot = (flown / "run" / "report.html").read_text("utf-8").partition("<footer>")[2]
    assert f"code {made.code[: version.DIGEST_CHARACTERS]}" in foot
    assert f"Python {made.python}, numpy {made.packages['numpy']}" in foot


def test_bundle_repeats_its_run_bit_by_bit(flown: Path, tmp_path: Path) -> None:
    done = zenpark("run", str(flown / "run.zip"), "--no-report", "--out", str(tmp_path / "again"))
    assert done.exit_code == 0, done.output
    assert done.stdout.endswith("the same as in the bundle, to the last bit: figures and recordings\n")
    assert (tmp_path / "again" / "metrics.json").read_bytes() == (flown / "run" / "metrics.json").read_bytes()
    origin = run_folder.read_origin(tmp_path / "again")
    assert origin is not None
    assert (origin.command, origin.file) == (f"./zenpark run {flown / 'run.zip'}", "short.toml")


def test_the_same_run_makes_the_same_archive(flown: Path, tmp_path: Path) -> None:
    bundle.write(flown / "run", tmp_path / "run.zip", [])
    assert (tmp_path / "run.zip").read_bytes() == (flown / "run.zip").read_bytes()


def rewritten(source: Path, target: Path, **changed: bytes) -> Path:
    """A copy of a bundle, with other members; checksums are left as they were."""
    with zipfile.ZipFile(source) as old, zipfile.ZipFile(target, "w") as new:
        for name in old.namelist():
            new.writestr(name, changed.get(name.replace(".", "_"), old.read(name)))
    return target


def test_what_comes_out_otherwise_is_said(flown: Path, tmp_path: Path) -> None:
    unpacked = tmp_path / "former"
    bundle.unpack(flown / "run.zip", unpacked)
    assert bundle.differences(flown / "run", unpacked) == []
    figures = json.loads((unpacked / "metrics.json").read_bytes())
    figures[0]["mean"]["iae"] += 1e-15
    (unpacked / "metrics.json").write_text(json.dumps(figures))
    (unpacked / "other.mcap").write_bytes((unpacked / "event.mcap").read_bytes())
    found = bundle.differences(flown / "run", unpacked)
    assert [each.partition(" ")[0] for each in found] == ["figures:", "other.mcap"]
    assert "[0].mean.iae" in found[0]


@pytest.mark.parametrize(
    ("member", "says"),
    [("experiment_toml", "experiment.toml is not what was put into it"), ("SHA256SUMS", "nothing.txt is missing")],
)
def test_a_damaged_bundle_is_refused(flown: Path, tmp_path: Path, member: str, says: str) -> None:
    damaged = rewritten(flown / "run.zip", tmp_path / "damaged.zip", **{member: b"0  nothing.txt\n"})
    done = zenpark("run", str(damaged), "--out", str(tmp_path / "out"))
    assert isinstance(done.exception, RecordingError)
    assert says in str(done.exception)
    assert not (tmp_path / "out").exists()


def test_what_is_no_bundle_is_refused(tmp_path: Path) -> None:
    (tmp_path / "text.zip").write_text("hello")
    with zipfile.ZipFile(tmp_path / "other.zip", "w") as archive:
        archive.writestr("../outside.txt", "climbs out")
    for name in ("text.zip", "other.zip", "missing.zip"):
        with pytest.raises(RecordingError, match=name):
            bundle.unpack(tmp_path / name, tmp_path / "into" / name)
    assert not (tmp_path / "into" / "outside.txt").exists()
    assert not (tmp_path / "outside.txt").exists()


def test_links_stay_out_and_large_files_are_chunked(flown: Path, tmp_path: Path, monkeypatch) -> None:
    folder = shutil.copytree(flown / "run", tmp_path / "run")
    (tmp_path / "secret").write_text("of the user")
    (folder / "notes.txt").symlink_to(tmp_path / "secret")
    (folder / "more").symlink_to(tmp_path)
    monkeypatch.setattr(bundle, "PIECE", 1000)
    bundle.write(folder, tmp_path / "run.zip", [])
    assert (tmp_path / "run.zip").read_bytes() == (flown / "run.zip").read_bytes()


def test_failed_bundles_leave_the_former_one(flown: Path, tmp_path: Path, monkeypatch) -> None:
    target = tmp_path / "run.zip"
    target.write_text("the former one")

    def full(*_: object) -> str:
        raise OSError(errno.ENOSPC, "No space left on device", "run.zip")

    monkeypatch.setattr(bundle, "_add", full)
    with pytest.raises(RecordingError, match="No space left"):
        bundle.write(flown / "run", target, [])
    assert [(file.name, file.read_text()) for file in tmp_path.iterdir()] == [("run.zip", "the former one")]


@pytest.mark.parametrize("name", ["run.json", "metrics.json", "a\0b.toml", f"{'x' * 300}.toml", "experiment.toml"])
def test_names_in_bundles_overwrite_nothing(name: str, flown: Path, tmp_path: Path) -> None:
    origin = json.loads((flown / "run" / "run.json").read_bytes())
    changed = json.dumps(origin | {"file": f"sub/{name}"}).encode()
    with zipfile.ZipFile(flown / "run.zip") as old:
        sums = old.read("SHA256SUMS").decode().splitlines(keepends=True)
    kept = "".join(line for line in sums if not line.endswith("  run.json\n")).encode()
    bundle.unpack(
        rewritten(flown / "run.zip", tmp_path / "odd.zip", run_json=changed, SHA256SUMS=kept), tmp_path / "into"
    )
    assert (tmp_path / "into" / "run.json").read_bytes() == changed
    assert (tmp_path / "into" / "metrics.json").read_bytes() == (flown / "run" / "metrics.json").read_bytes()


def test_repetition_with_json_prints_one_document(flown: Path, tmp_path: Path) -> None:
    done = zenpark("run", str(flown / "run.zip"), "--no-report", "--json", "--out", str(tmp_path / "again"))
    assert done.exit_code == 0, done.output
    assert {"cases"} <= json.loads(done.stdout).keys()


def test_control_sequences_of_a_bundle_stay_out(flown: Path, tmp_path: Path) -> None:
    folder = shutil.copytree(flown / "run", tmp_path / "run")
    origin = json.loads((folder / "run.json").read_bytes())
    origin["made_by"]["packages"]["numpy"] = origin["title"] = "\x1b]0;owned\x07\x1b[2J"
    (folder / "run.json").write_text(json.dumps(origin))
    assert zenpark("export", str(folder), "--bundle").exit_code == 0
    again = zenpark("run", str(tmp_path / "run.zip"), "--no-report", "--out", str(tmp_path / "again"))
    compared = zenpark("report", str(folder), str(tmp_path / "again"), "--out", str(tmp_path / "page.html"))
    past = zenpark("runs", "--past", "--in", str(tmp_path))
    for said in (again, compared, past):
        assert said.exit_code == 0, said.output
        assert "\x1b" not in said.output
    assert "owned" in again.output + compared.output


def test_a_bundle_takes_no_options_of_its_run(flown: Path) -> None:
    done = zenpark("run", str(flown / "run.zip"), "--seed", "7")
    assert "a bundle repeats its own run" in str(done.exception)


def test_folder_without_provenance_is_refused(tmp_path: Path) -> None:
    with pytest.raises(RecordingError, match=r"has no run\.json"):
        bundle.write(tmp_path, tmp_path / "run.zip", [])


def test_other_code_and_versions_are_named() -> None:
    here = version.provenance()
    other = msgspec.structs.replace(here, code="0" * 64, python="2.7", plugins={"mine": "1.0"}, host="elsewhere")
    assert here.differences(here) == []
    assert here.differences(other) == [
        f"code {here.code[:8]}, not 00000000",
        f"Python {here.python}, not 2.7",
        "no plug-ins of mine, the other with version 1.0",
    ]
    assert other.differences(here)[-1] == "plug-ins of mine 1.0, the other without"
    without = msgspec.structs.replace(here, packages={"numpy": here.packages["numpy"]})
    assert here.differences(without) == without.differences(here) == []  # what it did without cannot have mattered
    assert set(version.provenance('trigger = "periodic"').plugins) == set()


def test_tags_are_words(flown: Path) -> None:
    done = zenpark("run", str(flown / "short.toml"), "--virtual", "--tag", "a,b")
    assert done.exit_code == 2
    assert "a tag is a word without commas" in done.output
