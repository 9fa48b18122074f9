"""Build of zenohd with its REST and storage plugins from crates.io, once per version, into a cache.

`python -m tests.system.zenohd` builds it in about ten minutes, goes on where an earlier attempt was ended, and prints
the folder; `./zenpark test --all` does so before its tests of processes. Neither PyPI nor Debian has a zenohd. Without
one the tests that need it are skipped and say why.
"""

import fcntl
import json
import os
import shutil
import subprocess
import sys
from contextlib import suppress
from importlib.metadata import version
from pathlib import Path

VERSION = version("eclipse-zenoh")  # the same as the library of the robots
CRATES = ("zenohd", "zenoh-plugin-rest", "zenoh-plugin-storage-manager")
CACHE = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "zenpark" / f"zenohd-{VERSION}"
BUILT = CACHE / "bin"
REASON = CACHE / "reason.txt"  # why the last build failed
NO_CARGO = "no zenohd on PATH, and no cargo to build one"
ONLINE = {"CARGO_NET_RETRY": "1", "CARGO_HTTP_TIMEOUT": "20"}  # without crates.io: no minutes of waiting

# `cargo metadata` fetches the sources of dependencies; that zenohd has no library is a warning
_FETCH = """
[package]
name = "sources"
version = "0.0.0"
edition = "2021"
[lib]
path = "sources.rs"
[dependencies]
{dependencies}
"""
# One workspace: a plugin is loaded only by a zenohd with the same compiler and the same features of its libraries.
# A release with link-time optimisation would take three times as long.
_WORKSPACE = """
[workspace]
resolver = "2"
members = {members}
[profile.release]
lto = "off"
opt-level = 1
codegen-units = 16
debug = false
"""


class NotBuilt(Exception):
    """No zenohd, and why."""


def folder():
    """The folder with `zenohd` and its plugins: on PATH, or built before."""
    if (found := shutil.which("zenohd")) is not None:
        return Path(found).resolve().parent
    if (BUILT / "zenohd").exists():
        return BUILT
    if shutil.which("cargo") is None:
        raise NotBuilt(NO_CARGO)
    why = REASON.read_text().strip() if REASON.exists() else "`./zenpark test --all` builds one"
    raise NotBuilt(f"no zenohd on PATH or in {BUILT}: {why}")


def build(jobs):
    """Builds zenohd unless there is one; one process at a time, others wait for it."""
    with suppress(NotBuilt):
        return folder()
    if shutil.which("cargo") is None:
        raise NotBuilt(NO_CARGO)
    CACHE.mkdir(parents=True, exist_ok=True)
    with (CACHE / "lock").open("w") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        with suppress(NotBuilt):
            return folder()
        try:
            _build(CACHE / "build", jobs)
        except (OSError, NotBuilt) as error:
            REASON.write_text(str(error))
            raise NotBuilt(str(error)) from None
        REASON.unlink(missing_ok=True)
    return folder()


def _build(work, jobs):
    sources = work / "sources"
    sources.mkdir(parents=True, exist_ok=True)
    dependencies = "\n".join(f'{name} = "={VERSION}"' for name in CRATES)
    (sources / "Cargo.toml").write_text(_FETCH.format(dependencies=dependencies))
    (sources / "sources.rs").touch()
    said = _cargo("metadata", "--format-version", "1", where=sources)
    (registry,) = {
        Path(package["manifest_path"]).parent.parent
        for package in json.loads(said)["packages"]
        if package["name"] == CRATES[1]
    }
    members = [f"{name}-{VERSION}" for name in CRATES]
    for member in members:
        shutil.copytree(registry / member, work / member, dirs_exist_ok=True)
    (work / "Cargo.toml").write_text(_WORKSPACE.format(members=json.dumps(members)))
    shutil.copy(work / members[0] / "Cargo.lock", work / "Cargo.lock")  # the dependencies of the release
    _cargo("build", "--release", "--workspace", f"-j{jobs}", where=work)
    half = CACHE / "half"
    shutil.rmtree(half, ignore_errors=True)
    half.mkdir()
    release = work / "target" / "release"
    for file in (release / "zenohd", *release.glob("libzenoh_plugin_*")):
        if file.suffix in {"", ".so", ".dylib"}:
            shutil.copy(file, half)
    half.rename(BUILT)
    shutil.rmtree(work)


def _cargo(*arguments, where):
    """Standard output of cargo."""
    options = {"cwd": where, "env": {**ONLINE, **os.environ}, "stdin": subprocess.DEVNULL}
    done = subprocess.run(
        ["cargo", *arguments], capture_output=True, text=True, errors="replace", check=False, **options
    )
    if done.returncode != 0:
        raise NotBuilt(f"cargo {arguments[0]} failed: {' | '.join(done.stderr.strip().splitlines()[-4:])}")
    return done.stdout


def main():
    """Builds it and prints its folder."""
    try:
        print(build(jobs=os.cpu_count() or 1))
    except NotBuilt as not_built:
        print(f"no zenohd: {not_built}", file=sys.stderr)
        return 1
    return 0


if __name__ == "__main__":
    sys.exit(main())
