"""Several "machines": network namespaces joined by a bridge, a real sshd in each, and the files of each on its own.

Nothing leaves the namespaces: they have addresses of their own, and no way out. Needs root, `ip` and `sshd`.
"""

import contextlib
import os
import secrets
import shutil
import signal
import stat
import subprocess
import sys
import textwrap
import time
from pathlib import Path

import psutil

from tests.system.lab import ROOT, until

SSHD = shutil.which("sshd") or "/usr/sbin/sshd"
NET = "10.77.0"
PORT = 22


def why_not():
    """What these tests lack here; empty if nothing."""
    if os.geteuid() != 0:
        return "needs root, for network namespaces"
    for what, path in (("iproute2", shutil.which("ip")), ("openssh-server", SSHD if Path(SSHD).exists() else None)):
        if path is None:
            return f"needs {what}: apt-get install {what}"
    name = f"zp{secrets.token_hex(3)}"
    made = subprocess.run(["ip", "netns", "add", name], capture_output=True, text=True, check=False)
    if made.returncode != 0:
        return f"may not make network namespaces here: {made.stderr.strip()}"
    subprocess.run(["ip", "netns", "del", name], check=True)
    return ""


def ip(*words):
    subprocess.run(["ip", *words], check=True, capture_output=True)


class Machine:
    """One namespace with its address, its host key, and an sshd that takes the lab's key."""

    def __init__(self, lab, name, number):
        self.lab, self.name = lab, name
        self.address = f"{NET}.{number}"
        self.namespace = f"{lab.prefix}{name}"
        self.folder = lab.folder / name
        self.folder.mkdir()
        self._sshd = None

    def plug_in(self):
        inner, outer = f"{self.lab.prefix}i{self.name[-1]}", f"{self.lab.prefix}o{self.name[-1]}"
        ip("netns", "add", self.namespace)
        ip("link", "add", outer, "type", "veth", "peer", "name", inner)
        ip("link", "set", inner, "netns", self.namespace)
        ip("link", "set", outer, "netns", self.lab.switch)
        ip("-n", self.lab.switch, "link", "set", outer, "master", "bridge", "up")
        ip("-n", self.namespace, "addr", "add", f"{self.address}/24", "dev", inner)
        for link in (inner, "lo"):
            ip("-n", self.namespace, "link", "set", link, "up")
        self.outer = outer

    def unplug(self):
        ip("-n", self.lab.switch, "link", "set", self.outer, "down")

    def plug_in_again(self):
        ip("-n", self.lab.switch, "link", "set", self.outer, "up")

    def serve(self):
        key = self.folder / "host_key"
        subprocess.run(["ssh-keygen", "-q", "-t", "ed25519", "-N", "", "-f", str(key)], check=True)
        config = self.folder / "sshd_config"
        config.write_text(
            textwrap.dedent(
                f"""\
                Port {PORT}
                ListenAddress {self.address}
                HostKey {key}
                AuthorizedKeysFile {self.lab.key}.pub
                PidFile {self.folder}/sshd.pid
                PasswordAuthentication no
                UsePAM no
                StrictModes no
                """
            )
        )
        Path("/run/sshd").mkdir(exist_ok=True)
        with (self.folder / "sshd.log").open("wb") as log:
            self._sshd = subprocess.Popen(
                ["ip", "netns", "exec", self.namespace, SSHD, "-D", "-e", "-f", str(config)],
                stdin=subprocess.DEVNULL,
                stdout=log,
                stderr=log,
            )
        known = key.with_suffix(".pub").read_text().split()
        with self.lab.known_hosts.open("a") as file:
            file.write(f"{self.address} {known[0]} {known[1]}\n")
        until((self.folder / "sshd.pid").exists, f"sshd of {self.name} runs", 10.0)

    def zenpark_file(self, *, offset_s=0.0, drift=0.0):
        """The zenpark of this machine, as a command; its clock may be wrong."""
        command = self.folder / "zenpark"
        fake = self.folder / "site"
        fake.mkdir(exist_ok=True)
        if offset_s or drift:
            (fake / "sitecustomize.py").write_text(
                textwrap.dedent(
                    f"""\
                    import time
                    monotonic, reading, utc = time.monotonic, time.clock_gettime, time.time
                    time.monotonic = lambda: monotonic() * {1.0 + drift!r}
                    time.clock_gettime = lambda clock: reading(clock) * {1.0 + drift!r}
                    time.time = lambda: utc() + {offset_s!r} + {drift!r} * (utc() - {time.time()!r})
                    """
                )
            )
        command.write_text(
            f'#!/bin/sh\nPYTHONPATH={fake}:{ROOT} exec {sys.executable} -m tools.guard "$@"\n', encoding="utf-8"
        )
        command.chmod(command.stat().st_mode | stat.S_IXUSR)
        return command

    def command(self, *words):
        """A command line that runs here."""
        return ["ip", "netns", "exec", self.namespace, *words]

    def processes(self):
        """What runs in this namespace, but for its sshd and that one's children that serve connections."""
        pids = subprocess.run(["ip", "netns", "pids", self.namespace], capture_output=True, text=True, check=False)
        found = []
        for pid in map(int, pids.stdout.split()):
            with contextlib.suppress(psutil.NoSuchProcess, psutil.ZombieProcess):
                process = psutil.Process(pid)
                if process.name() != "sshd":
                    found.append(process)
        return found

    def close(self):
        if self._sshd is not None:
            self._sshd.terminate()
            self._sshd.wait(30)
        for pid in subprocess.run(
            ["ip", "netns", "pids", self.namespace], capture_output=True, text=True, check=False
        ).stdout.split():
            with contextlib.suppress(ProcessLookupError):
                os.kill(int(pid), signal.SIGKILL)
        subprocess.run(["ip", "netns", "del", self.namespace], check=False, capture_output=True)


class Machines:
    """The lab: a switch and machines on it; the first has no sshd and is the one in front of which one sits."""

    def __init__(self, folder, names):
        folder.mkdir(parents=True, exist_ok=True)
        self.folder, self.prefix = folder, f"zp{secrets.token_hex(2)}"
        self.switch = f"{self.prefix}sw"
        self.key, self.known_hosts = folder / "key", folder / "known_hosts"
        self.machines = {name: Machine(self, name, 10 + number) for number, name in enumerate(names)}

    def __getitem__(self, name):
        return self.machines[name]

    def __enter__(self):
        subprocess.run(["ssh-keygen", "-q", "-t", "ed25519", "-N", "", "-f", str(self.key)], check=True)
        self.known_hosts.touch()
        ip("netns", "add", self.switch)
        ip("-n", self.switch, "link", "add", "bridge", "type", "bridge")
        ip("-n", self.switch, "link", "set", "bridge", "up")
        for number, machine in enumerate(self.machines.values()):
            machine.plug_in()
            if number:
                machine.serve()
        self._wrap_ssh()
        return self

    def __exit__(self, *_):
        for machine in self.machines.values():
            machine.close()
        subprocess.run(["ip", "netns", "del", self.switch], check=False, capture_output=True)

    def _wrap_ssh(self):
        """The user's own configuration, which ssh looks for in the home folder of the password file only."""
        (self.folder / "bin").mkdir()
        config = self.folder / "ssh_config"
        names = "".join(f"Host {m.name}\n  HostName {m.address}\n" for m in self.machines.values())
        config.write_text(
            f"{names}Host *\n  User root\n  Port {PORT}\n  IdentityFile {self.key}\n  IdentitiesOnly yes\n"
            f"  UserKnownHostsFile {self.known_hosts}\n  StrictHostKeyChecking yes\n"
        )
        wrapper = self.folder / "bin" / "ssh"
        wrapper.write_text(f'#!/bin/sh\nexec {shutil.which("ssh")} -F {config} "$@"\n')
        wrapper.chmod(0o755)

    @property
    def environment(self):
        path = f"{self.folder / 'bin'}:{os.environ['PATH']}"
        return {**os.environ, "PATH": path, "PYTHONPATH": str(ROOT)}


@contextlib.contextmanager
def machines(folder, names):
    """A lab that is taken down whatever happens."""
    lab = Machines(folder, names)
    try:
        with lab:
            yield lab
    finally:
        lab.__exit__()
