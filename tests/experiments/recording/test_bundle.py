"""Bundles: a run in virtual time is repeated from one to the last bit; damaged and foreign archives are refused."""

import json
import shutil
import zipfile

import msgspec
import pytest

from experiments.recording import bundle, run_folder, version
from experiments.recording.reader import RecordingError, Records
from tests.commands import invoke
from tests.experiments.recordings import small_disk

pytestmark = pytest.mark.slow  # whole runs and their reports


@pytest.fixture(scope="module")
def bundled(tmp_path_factory):
    """Folder of a run with two seeds, one of two cases and a changed value."""
    folder = tmp_path_factory.mktemp("bundle")
    options = ["--virtual", "--case", "event", "--seed", "5", "--seeds", "2", "--set", "safety.margin=0.1"]
    invoke("run", "triangle", *options, "--set", "duration_s=3", "--tag", "demo", "--out", folder / "run")
    invoke("export", folder / "run", "--bundle")
    return folder


def test_run_records_how_where_and_with_what(bundled):
    origin = run_folder.read_origin(bundled / "run")
    assert origin.command.startswith("./zenpark run triangle --virtual --case event --set 'safety.margin")
    assert (origin.seeds, origin.cases, origin.tags) == (2, ["event"], ["demo"])
    assert origin.ended >= origin.begun
    made, known = origin.made_by, {"numpy": version.provenance().packages["numpy"], "code": version.digest()}
    assert {"numpy": made.packages["numpy"], "code": made.code} == known
    records = Records(bundled / "run" / "event.mcap")
    list(records.messages())
    assert records.metadata[0].metadata.items() >= {**known, "host": made.host}.items()
    foot = (bundled / "run" / "report.html").read_text("utf-8").partition("<footer>")[2]
    assert f"code {made.code[: version.DIGEST_CHARACTERS]}" in foot


def test_bundle_repeats_its_run_bit_by_bit(bundled, tmp_path):
    again = tmp_path / "again"
    done = invoke("run", bundled / "run.zip", "--no-report", "--out", again)
    assert done.stdout.endswith("the same as in the bundle, to the last bit: figures and recordings\n")
    assert (again / "metrics.json").read_bytes() == (bundled / "run" / "metrics.json").read_bytes()
    origin = run_folder.read_origin(again)
    assert (origin.command, origin.file) == (f"./zenpark run {bundled / 'run.zip'}", "triangle.toml")
    done = invoke("run", bundled / "run.zip", "--seed", "7", code=None)
    assert "a bundle repeats its own run" in str(done.exception)


def rewritten(source, target, **changed):
    """A copy of a bundle, with other members; checksums are left as they were."""
    with zipfile.ZipFile(source) as old, zipfile.ZipFile(target, "w") as new:
        for name in old.namelist():
            new.writestr(name, changed.get(name.replace(".", "_"), old.read(name)))
    return target


def test_what_comes_out_otherwise_is_said(bundled, tmp_path):
    unpacked = tmp_path / "former"
    bundle.unpack(bundled / "run.zip", unpacked)
    assert bundle.differences(bundled / "run", unpacked) == []
    figures = json.loads((unpacked / "metrics.json").read_bytes())
    figures[0]["mean"]["iae"] += 1e-15
    (unpacked / "metrics.json").write_text(json.dumps(figures))
    (unpacked / "other.mcap").write_bytes((unpacked / "event.mcap").read_bytes())
    found = bundle.differences(bundled / "run", unpacked)
    assert [each.partition(" ")[0] for each in found] == ["figures:", "other.mcap"]
    assert "[0].mean.iae" in found[0]


def test_a_bundle_without_its_results_is_not_repeated(bundled, tmp_path):
    unpacked = tmp_path / "former"
    bundle.unpack(bundled / "run.zip", unpacked)
    (unpacked / "event.mcap").unlink()
    table = unpacked / "metrics.csv"
    table.write_text(table.read_text("utf-8").replace("event", "events"), "utf-8")
    found = bundle.differences(bundled / "run", unpacked)
    assert found == ["metrics.csv: another table", "event.mcap is missing in the bundle"]


@pytest.mark.parametrize(
    ("member", "says"),
    [("experiment_toml", "experiment.toml is not what was put into it"), ("SHA256SUMS", "nothing.txt is missing")],
)
def test_a_damaged_bundle_is_refused(bundled, tmp_path, member, says):
    damaged = rewritten(bundled / "run.zip", tmp_path / "damaged.zip", **{member: b"0  nothing.txt\n"})
    error = invoke("run", damaged, "--out", tmp_path / "out", code=None).exception
    assert isinstance(error, RecordingError)
    assert says in str(error)
    assert not (tmp_path / "out").exists()


def test_what_is_no_bundle_is_refused(tmp_path):
    (tmp_path / "text.zip").write_text("hello")
    with zipfile.ZipFile(tmp_path / "other.zip", "w") as archive:
        archive.writestr("../outside.txt", "climbs out")
    for name in ("text.zip", "other.zip", "missing.zip"):
        with pytest.raises(RecordingError, match=name):
            bundle.unpack(tmp_path / name, tmp_path / "into" / name)
    assert not any((folder / "outside.txt").exists() for folder in (tmp_path, tmp_path / "into"))
    with pytest.raises(RecordingError, match=r"has no run\.json"):
        bundle.write(tmp_path, tmp_path / "run.zip", [])


def test_links_stay_out_and_large_files_are_chunked(bundled, tmp_path):
    folder = shutil.copytree(bundled / "run", tmp_path / "run")
    (tmp_path / "secret").write_text("of the user")
    (folder / "notes.txt").symlink_to(tmp_path / "secret")
    (folder / "more").symlink_to(tmp_path)
    archive = bundle.write(folder, tmp_path / "run.zip", [])
    assert archive.read_bytes() == (bundled / "run.zip").read_bytes()
    (folder / "large").write_bytes(large := bytes(range(256)) * 10_000)  # more than two pieces
    bundle.unpack(bundle.write(folder, tmp_path / "large.zip", []), tmp_path / "into")
    assert (tmp_path / "into" / "large").read_bytes() == large
    archive.write_text("the former one")
    with small_disk(10_000), pytest.raises(RecordingError, match="File too large"):
        bundle.write(folder, archive, [])
    assert archive.read_text() == "the former one", "a bundle that fails leaves it"
    assert not list(tmp_path.glob(".*"))


@pytest.mark.parametrize("name", ["run.json", "metrics.json", "a\0b.toml", f"{'x' * 300}.toml"])
def test_names_in_bundles_overwrite_nothing(name, bundled, tmp_path):
    origin, source = json.loads((bundled / "run" / "run.json").read_bytes()), bundled / "run.zip"
    changed = json.dumps(origin | {"file": f"sub/{name}"}).encode()
    with zipfile.ZipFile(source) as old:
        sums = old.read("SHA256SUMS").decode().splitlines(keepends=True)
    kept = "".join(line for line in sums if not line.endswith("  run.json\n")).encode()
    bundle.unpack(rewritten(source, tmp_path / "odd.zip", run_json=changed, SHA256SUMS=kept), tmp_path / "into")
    assert (tmp_path / "into" / "run.json").read_bytes() == changed
    assert (tmp_path / "into" / "metrics.json").read_bytes() == (bundled / "run" / "metrics.json").read_bytes()


def test_control_sequences_of_a_bundle_stay_out(bundled, tmp_path):
    folder = shutil.copytree(bundled / "run", tmp_path / "run")
    origin = json.loads((folder / "run.json").read_bytes())
    origin["made_by"]["packages"]["numpy"] = origin["title"] = "\x1b]0;owned\x07\x1b[2J"
    (folder / "run.json").write_text(json.dumps(origin))
    invoke("export", folder, "--bundle")
    again = invoke("run", tmp_path / "run.zip", "--no-report", "--out", tmp_path / "again")
    compared = invoke("report", folder, tmp_path / "again", "--out", tmp_path / "page.html")
    past = invoke("runs", "--past", "--in", tmp_path)
    assert "\x1b" not in again.output + compared.output + past.output
    assert "owned" in again.output + compared.output


def test_other_code_and_versions_are_named():
    here = version.provenance()
    other = msgspec.structs.replace(here, code="0" * 64, python="2.7", plugins={"mine": "1.0"}, host="elsewhere")
    said = [f"code {here.code[:8]}, not 00000000", f"Python {here.python}, not 2.7"]
    assert here.differences(other) == [*said, "no plug-ins of mine, the other with version 1.0"]
    assert other.differences(here)[-1] == "plug-ins of mine 1.0, the other without"
    without = msgspec.structs.replace(here, packages={"numpy": here.packages["numpy"]})
    assert here.differences(without) == without.differences(here) == []  # what it did without cannot have mattered
    assert not version.provenance('trigger = "periodic"').plugins
