"""Hosts by way of an `ssh` that runs everything on this machine: check, install, certificates, and a whole run."""

import io
import json
import os
import shutil
import stat
import subprocess
import sys
import tarfile

import pytest

from experiments.definition.experiment import Host
from experiments.file import catalogue
from experiments.file.problems import DocumentError
from experiments.real_time.hosts import authority
from experiments.real_time.hosts.hosts import HostError
from experiments.real_time.hosts.installation import PUT_CERTIFICATES, PUT_ZENPARK, packed, put, send
from experiments.recording import playback, version
from tests.system.lab import ROOT, Flight
from tools.commands import hosts as tool
from tools.commands.hosts import HEADING, choose
from tools.progress import columns

SHORT = ("--case", "event", "--set", "duration_s=2", "--no-report")
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


def program(place, text):
    place.parent.mkdir(parents=True, exist_ok=True)
    place.write_text(text)
    place.chmod(0o755)


@pytest.fixture
def home(tmp_path, monkeypatch):
    """The home folder of the one host that there is, which has this zenpark."""
    folder = tmp_path / "home"
    program(folder / "zenpark" / "zenpark", f'#!/bin/sh\nPYTHONPATH={ROOT} exec {sys.executable} -m tools.guard "$@"\n')
    program(tmp_path / "bin" / "ssh", FAKE.format(python=sys.executable, home=str(folder)))
    monkeypatch.setenv("PATH", f"{tmp_path / 'bin'}:{os.environ['PATH']}")
    return folder


def file_with_hosts(folder, **hosts):
    file = folder / "x.toml"
    text = catalogue.path("triangle").read_text("utf-8")
    for name, fields in hosts.items():
        text += f"\n[hosts.{name}]\n" + "".join(f"{key} = {json.dumps(value)}\n" for key, value in fields.items())
    file.write_text(text)
    return str(file)


@pytest.mark.system
def test_check_makes_a_row_of_each(home, tmp_path, capsys):
    lab1, lab2 = {"address": "lab1", "robots": ["CF01"], "tags": ["radio"]}, {"address": "nobody", "robots": ["KH01"]}
    file = file_with_hosts(tmp_path, lab1=lab1, lab2=lab2, lab3={"robots": ["KH02"]})
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
    file = file_with_hosts(tmp_path, lab1={"address": "lab1", "robots": ["CF01", "KH01"]})
    assert Flight(tmp_path / "run", file, *SHORT).finish(60.0)[0] == 0
    trace = playback.read(tmp_path / "run" / "event.mcap").trace
    assert [lie.host for lie in trace.clocks] == ["lab1"]
    assert not trace.lost.any()
    assert "CF01: done (finished)" in (tmp_path / "run" / "logs" / "event-CF01.log").read_text()
    file = file_with_hosts(tmp_path, lab1={"address": "nobody", "robots": ["CF01", "KH01"]})
    assert Flight(tmp_path / "here", file, *SHORT, "--here").finish(60.0)[0] == 0
    assert playback.read(tmp_path / "here" / "event.mcap").trace.clocks == ()


@pytest.mark.system
def test_another_zenpark_is_refused_before_anything_moves(home, tmp_path):
    command = home / "zenpark" / "zenpark"
    serve = "from experiments.real_time.hosts.station import serve; serve()"
    old = f"import experiments.recording.version as v; v.digest = lambda: 'f' * 64; {serve}"
    command.write_text(f'#!/bin/sh\nPYTHONPATH={ROOT} exec {sys.executable} -c "{old}"\n')
    flight = Flight(tmp_path / "run", file_with_hosts(tmp_path, lab1={"address": "lab1", "robots": ["CF01"]}))
    flight.until_said(rf"lab1: another zenpark is there \(ffffffff, here {version.digest()[:8]}\)")
    assert flight.finish()[0] == 2


def test_hosts_are_chosen_by_name_or_tag():
    lines = columns([HEADING, ["a", "✓ b", *["–"] * 5], ["longer", "✗", *["–"] * 5]])
    assert {line.index(mark) for line, mark in zip(lines, ("reachable", "✓", "✗"), strict=True)} == {8}
    lab_folder = {"lab1": Host(address="a", tags=["radio"]), "lab2": Host(address="b")}
    assert list(choose(lab_folder, [])) == ["lab1", "lab2"]
    assert list(choose(lab_folder, ["radio"])) == ["lab1"]
    assert list(choose(lab_folder, ["lab2", "radio"])) == ["lab1", "lab2"]
    with pytest.raises(DocumentError, match="there are: lab1, lab2, radio"):
        choose(lab_folder, ["lab9"])
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
    program(folder / ".venv" / "bin" / "python", f'#!/bin/sh\nexec {sys.executable} "$@"\n')
    (folder / ".venv" / "bin" / "zenpark").write_text("import sys\nfrom tools.guard import main\nmain()\n")
    bootstrap.ROOT, bootstrap.LOCKS = folder, {level: folder / path.name for level, path in bootstrap.LOCKS.items()}
    for path in (ROOT / "pyproject.toml", *ROOT.glob("requirements*.lock")):
        (folder / path.name).write_bytes(path.read_bytes())
    (folder / ".venv" / "zenpark.stamp").write_text(f"{bootstrap.fingerprint()} core\n")


@pytest.mark.mechanism("hosts: installation")
@pytest.mark.system
def test_install_puts_this_one_there_once(home, tmp_path, capsys, bootstrap):
    file = file_with_hosts(tmp_path, lab1={"address": "lab1", "robots": ["CF01"]})
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
def test_install_leaves_alone_what_is_not_its_own(home, tmp_path, capsys):
    (home / "zenpark" / "zenpark").write_text("#!/bin/sh\nexit 9\n")
    for there, message in ((".git", "is a git checkout"), ("thesis.tex", "holds something else")):
        (home / "zenpark" / there).mkdir()
        assert tool.install(file_with_hosts(tmp_path, lab1={"address": "lab1", "robots": ["CF01"]})) == 1
        assert message in capsys.readouterr().err
        assert (home / "zenpark" / "zenpark").read_text().startswith("#!/bin/sh")
        (home / "zenpark" / there).rmdir()


@pytest.mark.parametrize("script", [PUT_ZENPARK, PUT_CERTIFICATES])
def test_host_with_a_full_disk_says_one_sentence(tmp_path, monkeypatch, script):
    full = "#!/bin/sh\nfor each in a b; do echo tar: $each: Cannot write: No space left on device >&2; done; exit 2\n"
    program(tmp_path / "bin" / "tar", full)
    monkeypatch.setenv("PATH", f"{tmp_path / 'bin'}:{os.environ['PATH']}")
    words = ["sh", "-c", script, str(tmp_path / "zp"), "a"]
    done = subprocess.run(words, stdin=subprocess.DEVNULL, capture_output=True, check=False, text=True)
    (line,) = done.stderr.splitlines()
    assert line.startswith(
        f"{tmp_path / 'zp'} cannot be written: tar: a: Cannot write: No space left on device; make room"
    )
    assert not (tmp_path / "zp" / ".incoming").exists()


@pytest.fixture
def lab_folder(tmp_path):
    folder = tmp_path / "lab"
    authority.create(folder, {"router": "router", "KH01": "robot", "CF01": "robot"})
    return folder


def test_folder_holds_only_what_it_was_sent(home, lab_folder):
    host, there = Host(address="lab1", lab="~/keys of mine"), home / "keys of mine"
    assert send("lab1", host, lab_folder, ["KH01", "CF01"]) == "certificates of KH01, CF01 put into keys of mine"
    before = (there / "KH01.key").read_bytes()
    authority.renew(lab_folder, ["KH01"])
    assert send("lab1", host, lab_folder, ["KH01"]).endswith("; removed CF01.pem, CF01.key")
    assert {file.name for file in there.iterdir()} == {"KH01.key", "KH01.pem", "ca.pem"}
    assert before != (there / "KH01.key").read_bytes() == (lab_folder / "KH01.key").read_bytes()
    assert stat.S_IMODE(there.stat().st_mode) == 0o700
    assert {stat.S_IMODE(file.stat().st_mode) for file in there.iterdir()} == {0o600}


def test_what_is_not_its_own_is_left_alone(home, lab_folder):
    there = home / "zenpark-lab"
    for strange, said in (("ca.key", "is the lab's own folder"), ("thesis.tex", "holds something else (thesis.tex)")):
        there.mkdir()
        (there / strange).touch()
        (there / "CF01.key").touch()
        with pytest.raises(HostError, match="certificates not put there") as caught:
            send("lab1", Host(address="lab1"), lab_folder, ["KH01"])
        assert said in str(caught.value)
        assert 'lab = "zenpark-lab"' in str(caught.value)
        assert {file.name for file in there.iterdir()} == {strange, "CF01.key"}
        shutil.rmtree(there)


def test_hosts_need_folders_of_their_own(lab_folder):
    for place in ("zenpark", "/zenpark", "bin/zp"):
        with pytest.raises(HostError, match="names no folder of its own"):
            put("lab1", Host(address="a", zenpark=place))
    for place in ("", "~/", "/", ".", "../keys"):
        with pytest.raises(HostError, match="names no folder of its own"):
            send("lab1", Host(address="lab1", lab=place), lab_folder, ["KH01"])


def test_what_cannot_be_sent_is_said_before(home, lab_folder):
    authority.renew(lab_folder, ["CF01"], days=-0.01)
    with pytest.raises(HostError) as caught:
        send("lab1", Host(address="lab1"), lab_folder, ["KH01", "CF01", "TB01"])
    assert "lab1: the certificate of CF01 ended at" in str(caught.value)
    assert "lab1: TB01 is not in the lab" in str(caught.value)
    assert not (home / "zenpark-lab").exists()
    with pytest.raises(HostError, match="lab1: it cannot be reached"):
        send("lab1", Host(address="nobody"), lab_folder, ["KH01"])
