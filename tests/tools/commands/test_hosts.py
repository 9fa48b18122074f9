"""Hosts by way of an `ssh` that runs everything on this machine: check, install, and a whole run."""

import io
import json
import os
import sys
import tarfile
from pathlib import Path

import pytest

from experiments.file import catalogue
from experiments.file.problems import DocumentError
from experiments.real_time.hosts import hosts, installation
from experiments.real_time.hosts.installation import packed
from experiments.recording import playback, version
from tests.system.lab import ROOT, Flight
from tools.commands import hosts as tool
from tools.commands.hosts import HEADING, choose
from tools.progress import columns

FAKE = """\
#!{python}
import os, sys
words = sys.argv[1:]
at = words.index("--")
address, command = words[at + 1], words[at + 2]
if address == "nobody":
    sys.stderr.write("ssh: connect to host nobody port 22: Connection refused\\n")
    sys.exit(255)
for option, value in zip(words, words[1:]):
    if option == "-R":
        port = value.rpartition(":")[2]
        sys.stderr.write(f"Allocated port {{port}} for remote forward to 127.0.0.1:{{port}}\\n")
        sys.stderr.flush()
os.chdir({home!r})
os.execv("/bin/sh", ["sh", "-c", command])
"""


@pytest.fixture
def home(tmp_path, monkeypatch):
    """The home folder of the one host that there is, which has this zenpark."""
    folder = tmp_path / "home"
    (folder / "zenpark").mkdir(parents=True)
    command = folder / "zenpark" / "zenpark"
    command.write_text(f'#!/bin/sh\nPYTHONPATH={ROOT} exec {sys.executable} -m tools.guard "$@"\n')
    command.chmod(0o755)
    (tmp_path / "bin").mkdir()
    fake = tmp_path / "bin" / "ssh"
    fake.write_text(FAKE.format(python=sys.executable, home=str(folder)))
    fake.chmod(0o755)
    monkeypatch.setenv("PATH", f"{tmp_path / 'bin'}:{os.environ['PATH']}")
    return folder


def experiment(folder, **hosts):
    file = folder / "x.toml"
    text = catalogue.path("triangle").read_text("utf-8")
    for name, fields in hosts.items():
        text += f"\n[hosts.{name}]\n" + "".join(f"{key} = {json.dumps(value)}\n" for key, value in fields.items())
    file.write_text(text)
    return str(file)


@pytest.mark.system
def test_check_makes_a_row_of_each(home, tmp_path, capsys):
    file = experiment(
        tmp_path,
        lab1={"address": "lab1", "robots": ["CF01"], "tags": ["radio"]},
        lab2={"address": "nobody", "robots": ["KH01"]},
        lab3={"robots": ["KH02"]},
    )
    assert tool.check(file, on=["radio"]) == 0
    row = capsys.readouterr().out.splitlines()[1]
    assert row.startswith("lab1")
    assert row.count("✓") == 6
    assert version.digest()[:8] in row
    assert tool.check(file) == 1
    out, errors = capsys.readouterr()
    rows = {line.split()[0]: line for line in out.splitlines()[1:]}
    assert "✗" in rows["lab2"]
    assert "no address: KH02 started there" in rows["lab3"]
    assert "lab2: it cannot be reached" in errors


@pytest.mark.system
def test_a_run_here_and_there(home, tmp_path):
    file = experiment(tmp_path, lab1={"address": "lab1", "robots": ["CF01", "KH01"]})
    short = ("--case", "event", "--set", "duration_s=2", "--no-report")
    flight = Flight(tmp_path / "run", file, *short)
    code, _ = flight.finish(60.0)
    assert code == 0
    trace = playback.read(tmp_path / "run" / "event.mcap").trace
    assert [lie.host for lie in trace.clocks] == ["lab1"]
    assert not trace.lost.any()
    log = (tmp_path / "run" / "logs" / "event-CF01.log").read_text()
    assert "CF01: done (finished)" in log


@pytest.mark.system
def test_hosts_can_be_left_out(home, tmp_path):
    file = experiment(tmp_path, lab1={"address": "nobody", "robots": ["CF01", "KH01"]})
    short = ("--case", "event", "--set", "duration_s=2", "--no-report")
    flight = Flight(tmp_path / "here", file, *short, "--here")
    assert flight.finish(60.0)[0] == 0
    assert playback.read(tmp_path / "here" / "event.mcap").trace.clocks == ()


@pytest.mark.system
def test_another_zenpark_is_refused_before_anything_moves(home, tmp_path):
    command = home / "zenpark" / "zenpark"
    serve = "from experiments.real_time.hosts.station import serve; serve()"
    old = f"import experiments.recording.version as v; v.digest = lambda: 'f' * 64; {serve}"
    command.write_text(f'#!/bin/sh\nPYTHONPATH={ROOT} exec {sys.executable} -c "{old}"\n')
    flight = Flight(tmp_path / "run", experiment(tmp_path, lab1={"address": "lab1", "robots": ["CF01"]}))
    flight.until_said("another zenpark is there")
    said = flight.said()
    assert flight.finish()[0] == 2
    assert f"lab1: another zenpark is there (ffffffff, here {version.digest()[:8]})" in said
    assert "zenpark hosts install FILE" in said


def test_a_table_has_straight_columns():
    lines = columns([HEADING, ["a", "✓ b", *["–"] * 5], ["longer", "✗", *["–"] * 5]])
    assert lines[0].split() == list(HEADING)
    assert {line.index(mark) for line, mark in zip(lines, ("reachable", "✓", "✗"), strict=True)} == {8}


def test_hosts_are_chosen_by_name_or_tag():
    lab = {"lab1": hosts.Host(address="a", tags=["radio"]), "lab2": hosts.Host(address="b")}
    assert list(choose(lab, [])) == ["lab1", "lab2"]
    assert list(choose(lab, ["radio"])) == ["lab1"]
    assert list(choose(lab, ["lab2", "radio"])) == ["lab1", "lab2"]
    with pytest.raises(DocumentError, match="there are: lab1, lab2, radio"):
        choose(lab, ["lab9"])
    with pytest.raises(DocumentError, match="all robots run here"):
        choose({}, [])


def test_package_holds_code_and_nothing_that_running_left():
    with tarfile.open(fileobj=io.BytesIO(packed(ROOT, ["agents", "zenpark"]))) as tar:
        names = tar.getnames()
        assert tar.getmember("zenpark").mode & 0o100
    assert "agents/network/keys.py" in names
    assert not [name for name in names if "__pycache__" in name]


def prepared(home, bootstrap):
    """A .venv for a zenpark that is put there, so that nothing needs to be brought from elsewhere."""
    folder = home / "zenpark"
    (folder / ".venv" / "bin").mkdir(parents=True)
    python = folder / ".venv" / "bin" / "python"
    python.write_text(f'#!/bin/sh\nexec {sys.executable} "$@"\n')
    python.chmod(0o755)
    entry = folder / ".venv" / "bin" / "zenpark"
    entry.write_text("import sys\nfrom tools.guard import main\nmain()\n")
    for name in ("ROOT", "LOCKS"):
        value = getattr(bootstrap, name)
        new = folder if name == "ROOT" else {level: folder / path.name for level, path in value.items()}
        setattr(bootstrap, name, new)
    for path in (ROOT / "pyproject.toml", *ROOT.glob("requirements*.lock")):
        (folder / path.name).write_bytes(path.read_bytes())
    (folder / ".venv" / "zenpark.stamp").write_text(f"{bootstrap.fingerprint()} core\n")


@pytest.mark.mechanism("hosts: installation")
@pytest.mark.system
def test_install_puts_this_one_there_once(home, tmp_path, capsys, bootstrap):
    file = experiment(tmp_path, lab1={"address": "lab1", "robots": ["CF01"]})
    command = home / "zenpark" / "zenpark"
    command.write_text("#!/bin/sh\nexit 9\n")
    (home / "zenpark" / "agents").mkdir()
    (home / "zenpark" / "agents" / "removed.py").touch()
    prepared(home, bootstrap)
    assert tool.install(file) == 0
    out = capsys.readouterr().out
    assert f"({version.digest()[:8]}) installed" in out
    assert command.read_bytes() == (ROOT / "zenpark").read_bytes()
    assert not (home / "zenpark" / "agents" / "removed.py").exists()
    assert not (home / "zenpark" / ".incoming").exists()
    assert tool.install(file, as_json=True) == 0
    (row,) = json.loads(capsys.readouterr().out)["hosts"]
    assert row == {"host": "lab1", "ok": True, "zenpark": f"has it already ({version.digest()[:8]})"}


@pytest.mark.system
@pytest.mark.parametrize(
    ("there", "message"),
    [(".git/x", "is a git checkout"), ("thesis.tex", "holds something else"), (None, "cannot be reached")],
)
def test_install_leaves_alone_what_is_not_its_own(home, tmp_path, capsys, there, message):
    if there is not None:
        (home / "zenpark" / "zenpark").write_text("#!/bin/sh\nexit 9\n")
        place = home / "zenpark" / there
        place.parent.mkdir(exist_ok=True)
        place.touch()
    address = "lab1" if there is not None else "nobody"
    file = experiment(tmp_path, lab1={"address": address, "robots": ["CF01"]})
    assert tool.install(file) == 1
    assert message in capsys.readouterr().err
    assert Path(home / "zenpark" / "zenpark").read_text().startswith("#!/bin/sh")


@pytest.mark.parametrize("place", ["zenpark", "~/zenpark", "/zenpark", "bin/zp"])
def test_host_command_needs_a_folder_of_its_own(place):
    with pytest.raises(hosts.HostError, match="names no folder of its own"):
        installation.put("lab1", hosts.Host(address="a", zenpark=place))
