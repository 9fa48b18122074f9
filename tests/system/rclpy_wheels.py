"""A real ROS 2 from the Python index: rclpy with Fast DDS and messages, once per version, in a cache.

`python -m tests.system.rclpy_wheels` installs it in half a minute (266 MB) and prints its Python; `./zenpark test
--all` does so before its tests of processes. Wheels are for Linux and CPython 3.10 to 3.13; none has rmw_zenoh or tf2.
"""

import fcntl
import os
import shutil
import subprocess
import sys
from pathlib import Path

MESSAGES = ("geometry", "sensor", "nav", "diagnostic", "visualization")
WHEELS = ("ros-rclpy==9.1.2", "ros-rmw-fastrtps-cpp==9.3.3", *(f"ros-{name}-msgs==5.5.1" for name in MESSAGES))
NAME = f"rclpy-9.1.2-{len(WHEELS)}-cp{sys.version_info.major}{sys.version_info.minor}"
CACHE = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "zenpark" / NAME
PYTHON = CACHE / "ros" / "bin" / "python"
REASON = CACHE / "reason.txt"  # why there is none; empty: it is complete
# no network but a loopback of its own, and an end for all its processes with the first
APART = ("unshare", "--map-root-user", "--net", "--pid", "--fork", "--kill-child")
LOOPBACK = ("sh", "-c", 'ip link set lo up && exec "$@"', "sh")


def missing():
    """Why there is no ROS 2 for tests; empty if there is one."""
    if not REASON.exists():
        return f"no rclpy in {CACHE}: `./zenpark test --all` installs one"
    if why := REASON.read_text().strip():
        return f"no rclpy in {CACHE}: {why}"
    if shutil.which(APART[0]) is None:
        return f"no {APART[0]}, to keep ROS off the network"
    tried = subprocess.run([*APART, *LOOPBACK, "true"], capture_output=True, text=True, check=False, errors="replace")
    return f"no network namespace for ROS: {tried.stderr.strip()}" if tried.returncode else ""


def install():
    """Installs it unless it is there, one process at a time; why there is none, or an empty text."""
    CACHE.mkdir(parents=True, exist_ok=True)
    with (CACHE / "lock").open("w") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        if not REASON.exists() or REASON.read_text():
            REASON.unlink(missing_ok=True)
            shutil.rmtree(CACHE / "ros", ignore_errors=True)
            REASON.write_text(_install())
    return missing()


def _install():
    pip = ["-m", "pip", "install", "--quiet", "--prefer-binary", "--retries", "1", "--timeout", "20", *WHEELS]
    for command in ([sys.executable, "-m", "venv", str(CACHE / "ros")], [str(PYTHON), *pip]):
        streams = {"stdin": subprocess.DEVNULL, "capture_output": True, "text": True, "errors": "replace"}
        done = subprocess.run(command, check=False, **streams)
        if done.returncode:
            return " | ".join((done.stderr or done.stdout).strip().splitlines()[-2:]) or "the installation failed"
    return ""


if __name__ == "__main__":
    why_not = install()
    print(why_not or PYTHON, file=sys.stderr if why_not else sys.stdout)
    sys.exit(bool(why_not))
