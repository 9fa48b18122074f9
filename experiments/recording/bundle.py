"""Bundle of a run: one archive with its file, results, recordings, plug-ins and origin, from which it is repeated."""

from __future__ import annotations

import errno
import hashlib
import json
import struct
import zipfile
import zlib
from collections.abc import Iterator
from importlib.metadata import distributions
from io import BytesIO
from pathlib import Path
from typing import Final

import msgspec

from agents.errors import replacing
from experiments.definition.plan import Plan
from experiments.file.choices import plugin_files
from experiments.recording.reader import RecordingError, Records
from experiments.recording.run_folder import METRICS, ORIGIN, SOURCE, RunOrigin, flattened, read_origin
from experiments.recording.version import PACKAGES, ROOT

SUFFIX: Final = ".zip"
LEFT_OUT: Final = ("logs", f"{ORIGIN}.new")  # parts of the run's folder
DATE: Final = (2000, 1, 1, 0, 0, 0)  # date of every member: the same run makes the same archive
SUMS: Final = "SHA256SUMS"
TABLE: Final = "metrics.csv"
PIECE: Final = 1 << 20  # [bytes] part in memory at once
MAX_BUNDLE_BYTES: Final = 1 << 34  # [bytes] limit of all members together
# what the library raises of archives that are damaged, ciphered or of another method
DAMAGED: Final = (
    OSError, zipfile.BadZipFile, zlib.error, struct.error, EOFError, ValueError, LookupError, RuntimeError
)  # fmt: skip
README: Final = """{title}

A run of zenpark, {date}, with all that is needed to repeat it:

    {command}

does what was done, from {source} with what `run.json` says ({version}). From this archive:

    ./zenpark run {name}

In virtual time the results are the same to the last bit, if code and versions are; zenpark says whether they are.

run.json          how it was made: command, code, versions, machine
requirements.txt  every Python package that was installed
plugins/          source of the plug-ins that it used
metrics.json      its figures; metrics.csv the same as a table
*.mcap            recordings
SHA256SUMS        of all files
"""


def write(folder: Path, target: Path, plans: list[Plan]) -> Path:
    """Write the bundle of a run.

    Args:
        plans: Its cases, with plug-ins that are added.

    Raises:
        RecordingError: If the folder has no `run.json`, or the archive cannot be written.
    """
    origin = read_origin(folder)
    if origin is None or not origin.file or not (folder / SOURCE).exists():
        raise RecordingError(f"{folder}: has no {ORIGIN} that says how it was made; run it again with this zenpark")
    made_by = origin.made_by
    text = README.format(
        title=origin.title or origin.file,
        date=origin.date,
        command=origin.command,
        source=SOURCE,
        version="an older zenpark" if made_by is None else f"zenpark {made_by.zenpark}, code {made_by.code}",
        name=target.name,
    )
    requirements = sorted({f"{each.name}=={each.version}\n" for each in distributions()}, key=str.lower)
    members: dict[str, Path | bytes] = dict(_files(folder, target))
    members |= {f"plugins/{file.name}": file for file in sorted(_plugins(plans))}
    members |= {"README.txt": text.encode(), "requirements.txt": "".join(requirements).encode()}
    try:
        with replacing(target) as draft, zipfile.ZipFile(draft, "w", zipfile.ZIP_DEFLATED) as archive:
            sums = [f"{_add(archive, name, members[name])}  {name}\n" for name in sorted(members)]
            _add(archive, SUMS, "".join(sums).encode())
    except OSError as error:
        raise RecordingError(f"{error.filename or target}: {error.strerror}: no bundle was made") from None
    return target


def _add(archive: zipfile.ZipFile, name: str, data: Path | bytes) -> str:
    """Add a member to an archive, a file piece by piece; the digest of what was added."""
    total = hashlib.sha256()
    member = zipfile.ZipInfo(name, DATE)
    member.compress_type = zipfile.ZIP_DEFLATED
    with (
        BytesIO(data) if isinstance(data, bytes) else data.open("rb") as source,
        archive.open(member, "w", force_zip64=True) as into,
    ):
        while piece := source.read(PIECE):
            total.update(piece)
            into.write(piece)
    return total.hexdigest()


def unpack(bundle: Path, into: Path) -> RunOrigin:
    """Unpack a bundle into an empty folder; raises RecordingError if it is no bundle, or a damaged one.

    Returns:
        Its origin, in which `file` is the experiment file in that folder, under its former name.
    """
    try:
        with zipfile.ZipFile(bundle) as archive:
            if sum(member.file_size for member in archive.infolist()) > MAX_BUNDLE_BYTES:
                raise RecordingError(f"{bundle}: more than {MAX_BUNDLE_BYTES >> 30} GB unpacked")
            archive.extractall(into)  # names with .. or / at the front are made harmless by the library
        sums = (into / SUMS).read_text("utf-8")
    except DAMAGED as error:
        if isinstance(error, OSError) and error.errno in (errno.ENOSPC, errno.EDQUOT):
            raise  # a good bundle, perhaps
        why = getattr(error, "strerror", None) or error
        raise RecordingError(f"{bundle}: is no bundle of `./zenpark export RUN --bundle`: {why}") from None
    for line in sums.splitlines():
        wanted, _, name = line.partition("  ")
        file = into / name
        if not file.resolve().is_relative_to(into.resolve()) or not file.is_file():
            raise RecordingError(f"{bundle}: {name} is missing in it")
        with file.open("rb") as content:
            found = hashlib.file_digest(content, "sha256").hexdigest()
        if found != wanted:
            raise RecordingError(f"{bundle}: {name} is not what was put into it")
    origin = read_origin(into)
    if origin is None or not origin.file or not (into / SOURCE).is_file():
        raise RecordingError(f"{bundle}: holds no {ORIGIN} and {SOURCE}")
    former = Path(origin.file)
    file = into / (former.name if former.suffix in (".toml", ".json") else f"{former.name}.toml")
    try:
        with file.open("xb") as copy:
            copy.write((into / SOURCE).read_bytes())
    except (OSError, ValueError):  # the name of another member, such as run.json, or of no file
        file = into / SOURCE
    return msgspec.structs.replace(origin, file=str(file))


def differences(repeated: Path, former: Path) -> list[str]:
    """Differences between the results of two folders of one run in virtual time, to the last bit; empty if nothing."""
    found = []
    try:
        repeat, original = (json.loads((folder / METRICS).read_bytes()) for folder in (repeated, former))
    except (OSError, ValueError, RecursionError) as error:
        raise RecordingError(f"{METRICS} cannot be compared: {error}") from None
    if repeat != original:
        old, new = dict(flattened(original)), dict(flattened(repeat))
        changed = [path for path in sorted(old.keys() | new.keys()) if old.get(path) != new.get(path)]
        found.append("figures: " + ", ".join(f"{path} {old.get(path)} → {new.get(path)}" for path in changed[:5]))
    if (repeated / TABLE).exists() and not _same(repeated / TABLE, former / TABLE):
        found.append(f"{TABLE}: another table")
    for name in sorted({file.name for folder in (repeated, former) for file in folder.glob("*.mcap")}):
        repeat, original = repeated / name, former / name
        if not (repeat.exists() and original.exists()):
            found.append(f"{name} is missing {'in the bundle' if repeat.exists() else 'in the repeated run'}")
        elif _messages(repeat) != _messages(original):
            found.append(f"{name}: other messages")
    return found


def _same(file: Path, other: Path) -> bool:
    return other.is_file() and file.read_bytes() == other.read_bytes()


def _messages(file: Path) -> str:
    """Digest of all messages of a recording, with topics and times, without what says who made it."""
    total = hashlib.sha256()
    records = Records(file)
    for message in records.messages():
        topic = records.channels[message.channel].topic
        total.update(f"{topic} {message.logged} {message.published}\0".encode() + message.data)
    return total.hexdigest()


def _files(folder: Path, target: Path) -> Iterator[tuple[str, Path]]:
    """Files of a run; links are left out, because what they lead to is not of the run."""
    for file in sorted(folder.rglob("*")):
        name = file.relative_to(folder)
        if file.is_symlink() or not file.is_file() or name.parts[0] in LEFT_OUT or file.suffix == SUFFIX:
            continue
        if not file.name.startswith(target.name):
            yield name.as_posix(), file


def _plugins(plans: list[Plan]) -> set[Path]:
    """Modules of the plug-ins that the cases choose, except our own."""
    files = {file for plan in plans for file in plugin_files(plan)}
    return {file for file in files if not any(file.is_relative_to(ROOT / package) for package in PACKAGES)}
