"""Several "machines": network namespaces joined by a bridge, a real sshd in each, and the files of each on its own.

The namespaces have addresses of their own, and no way out. Needs root, `ip` and `sshd`.
"""

import contextlib
import os
import secrets
import shutil
import subprocess
import sys
import textwrap
import time
from functools import cache
from pathlib import Path

import psutil

from tests.system.lab import ROOT, until

SSHD = shutil.which("sshd") or "/usr/sbin/sshd"
NET = "10.77.0"


@cache
def why_not():
    """What these tests lack here; empty if they lack nothing."""
    if os.geteuid() != 0:
        return "needs root, for network namespaces"
    for what, path in (("iproute2", shutil.which("ip")), ("openssh-server", Path(SSHD).exists())):
        if not path:
            return f"needs {what}: apt-get install {what}"
    name = f"zp{secrets.token_hex(3)}"
    made = subprocess.run(["ip", "netns", "add", name], capture_output=True, text=True, check=False)
    if made.returncode != 0:
        return f"may not make network namespaces here: {made.stderr.strip()}"
    ip(f"netns del {name}")
    return ""


def ip(words, *, check=True):
    return subprocess.run(["ip", *words.split()], check=check, capture_output=True, text=True).stdout


def make_key(file):
    subprocess.run(["ssh-keygen", "-q", "-t", "ed25519", "-N", "", "-f", str(file)], check=True)


class Machine:
    """One namespace with its address, its host key, and an sshd that takes the lab's key."""

    def __init__(self, lab, name, number):
        self.lab, self.name, self.address = lab, name, f"{NET}.{number}"
        self.namespace, self.folder = f"{lab.prefix}{name}", lab.folder / name
        self.folder.mkdir()
        self._sshd = None
        inner, self.outer = f"{lab.prefix}i{name[-1]}", f"{lab.prefix}o{name[-1]}"
        ip(f"netns add {self.namespace}")
        ip(f"link add {self.outer} type veth peer name {inner}")
        ip(f"link set {inner} netns {self.namespace}")
        ip(f"link set {self.outer} netns {lab.switch}")
        ip(f"-n {lab.switch} link set {self.outer} master bridge up")
        ip(f"-n {self.namespace} addr add {self.address}/24 dev {inner}")
        for link in (inner, "lo"):
            ip(f"-n {self.namespace} link set {link} up")

    def unplug(self):
        ip(f"-n {self.lab.switch} link set {self.outer} down")

    def plug_in_again(self):
        ip(f"-n {self.lab.switch} link set {self.outer} up")

    def serve(self):
        key, config = self.folder / "host_key", self.folder / "sshd_config"
        make_key(key)
        config.write_text(
            f"Port 22\nListenAddress {self.address}\nHostKey {key}\nAuthorizedKeysFile {self.lab.key}.pub\n"
            f"PidFile {self.folder}/sshd.pid\nPasswordAuthentication no\nUsePAM no\nStrictModes no\n"
        )
        Path("/run/sshd").mkdir(exist_ok=True)
        with (self.folder / "sshd.log").open("wb") as log:
            line = self.command(SSHD, "-D", "-e", "-f", str(config))
            self._sshd = subprocess.Popen(line, stdin=subprocess.DEVNULL, stdout=log, stderr=log)
        known = key.with_suffix(".pub").read_text().split()
        with self.lab.known_hosts.open("a") as file:
            file.write(f"{self.address} {known[0]} {known[1]}\n")
        until((self.folder / "sshd.pid").exists, f"sshd of {self.name} runs", 10.0)

    def zenpark_file(self, *, offset_s=0.0, drift=0.0):
        """The zenpark of this machine, as a command; its clock may be wrong."""
        command, fake = self.folder / "zenpark", self.folder / "site"
        fake.mkdir(exist_ok=True)
        wrong = f"""\
            import time
            monotonic, reading, utc = time.monotonic, time.clock_gettime, time.time
            time.monotonic = lambda: monotonic() * {1.0 + drift!r}
            time.clock_gettime = lambda clock: reading(clock) * {1.0 + drift!r}
            time.time = lambda: utc() + {offset_s!r} + {drift!r} * (utc() - {time.time()!r})
            """
        (fake / "sitecustomize.py").write_text(textwrap.dedent(wrong) if offset_s or drift else "")
        own = f"PYTHONPATH={fake}:{ROOT} ZENPARK_RUNTIME_DIR={self.folder / 'runtime'}"
        command.write_text(f'#!/bin/sh\n{own} exec {sys.executable} -m tools.guard "$@"\n')
        command.chmod(0o755)
        return command

    def command(self, *words):
        """A command line that runs here."""
        return ["ip", "netns", "exec", self.namespace, *words]

    def processes(self):
        """What runs in this namespace, but for its sshd and that one's children that serve connections."""
        found = []
        for pid in ip(f"netns pids {self.namespace}", check=False).split():
            with contextlib.suppress(psutil.NoSuchProcess, psutil.ZombieProcess):
                process = psutil.Process(int(pid))
                if process.name() != "sshd":
                    found.append(process)
        return found

    def close(self):
        if self._sshd is not None:
            self._sshd.terminate()
            self._sshd.wait(100.0)
        for pid in ip(f"netns pids {self.namespace}", check=False).split():
            with contextlib.suppress(psutil.NoSuchProcess):
                psutil.Process(int(pid)).kill()
        ip(f"netns del {self.namespace}", check=False)


class Machines:
    """The lab: a switch and machines on it; the first has no sshd and is the one in front of which one sits."""

    def __init__(self, folder):
        folder.mkdir(parents=True, exist_ok=True)
        self.folder, self.prefix, self.machines = folder, f"zp{secrets.token_hex(2)}", {}
        self.switch, self.key, self.known_hosts = f"{self.prefix}sw", folder / "key", folder / "known_hosts"
        self.environment = {**os.environ, "PATH": f"{folder / 'bin'}:{os.environ['PATH']}", "PYTHONPATH": str(ROOT)}

    def __getitem__(self, name):
        return self.machines[name]

    def begin(self, names):
        make_key(self.key)
        self.known_hosts.touch()
        ip(f"netns add {self.switch}")
        ip(f"-n {self.switch} link add bridge type bridge")
        ip(f"-n {self.switch} link set bridge up")
        for number, name in enumerate(names):
            self.machines[name] = Machine(self, name, 10 + number)
            if number:
                self.machines[name].serve()
        # the user's own configuration, which ssh looks for in the home folder of the password file only
        config, wrapper = self.folder / "ssh_config", self.folder / "bin" / "ssh"
        hosts = "".join(f"Host {each.name}\n  HostName {each.address}\n" for each in self.machines.values())
        config.write_text(
            f"{hosts}Host *\n  User root\n  Port 22\n  IdentityFile {self.key}\n  IdentitiesOnly yes\n"
            f"  UserKnownHostsFile {self.known_hosts}\n  StrictHostKeyChecking yes\n"
        )
        wrapper.parent.mkdir()
        wrapper.write_text(f'#!/bin/sh\nexec {shutil.which("ssh")} -F {config} "$@"\n')
        wrapper.chmod(0o755)

    def close(self):
        for machine in self.machines.values():
            machine.close()
        ip(f"netns del {self.switch}", check=False)


@contextlib.contextmanager
def machines(folder, names):
    """A lab that is taken down whatever happens."""
    with contextlib.closing(Machines(folder)) as lab:
        lab.begin(names)
        yield lab
