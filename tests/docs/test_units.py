"""The systemd unit of docs/hosts.md is one that systemd takes, and starts a command that there is."""

import re
import shlex
import shutil
import subprocess
import sys

import pytest

from tests.commands import ROOT, zenpark

UNIT = re.search(r"```ini\n(\[Unit\].*?)```", (ROOT / "docs" / "hosts.md").read_text("utf-8"), re.DOTALL)


def unit():
    assert UNIT is not None
    return UNIT[1]


@pytest.mark.skipif(shutil.which("systemd-analyze") is None, reason="needs systemd-analyze: apt-get install systemd")
def test_systemd_takes_it(tmp_path):
    text = re.sub(r"ExecStart=\S+", f"ExecStart={sys.executable}", unit()).replace("User=pi", "User=root")
    file = tmp_path / "zenpark@CF01.service"
    file.write_text(text)
    done = subprocess.run(
        ["systemd-analyze", "verify", "--man=no", str(file)], capture_output=True, text=True, check=False, timeout=60
    )
    about = [line for line in done.stderr.splitlines() if file.name in line]
    assert done.returncode == 0, done.stderr
    assert not about, about


@pytest.mark.slow
def test_its_command_is_understood(tmp_path):
    (line,) = re.findall(r"^ExecStart=\S+ (.*)$", unit(), re.MULTILINE)
    words = shlex.split(line.replace("%i", "CF01"))
    assert words[:3] == ["agent", "join", "CF01"]
    words[words.index("--lab") + 1] = str(tmp_path)  # where there is no certificate
    done = zenpark(*words, code=2)
    assert "is missing" in done.stderr
    assert "Traceback" not in done.stderr
