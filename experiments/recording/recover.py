"""Makes a finished recording of one whose recorder was killed or ran out of disk."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from mcap.records import Channel
from mcap.writer import Writer

from experiments.recording.reader import Message, RecordingError, Records
from experiments.recording.writer import CHUNK_BYTES, WORLD


@dataclass(frozen=True)
class Recovered:
    """What was found.

    Attributes:
        messages: How many.
        robots: Whose, in the order in which they appear.
        complete: The source was whole already, and no target was written.
    """

    messages: int
    robots: tuple[str, ...]
    complete: bool


def recover(source: Path, target: Path) -> Recovered:
    """Writes every whole record of an unfinished recording into a new, finished one. The source stays as it is.

    Raises:
        RecordingError: If the source is no recording, or the target exists or cannot be written.
    """
    records = Records(source)
    messages = sum(1 for _ in records.messages())
    robots = tuple(dict.fromkeys(_robot(channel) for channel in records.channels.values()))
    if not records.complete:
        _write(source, target)
    return Recovered(messages, tuple(robot for robot in robots if robot), records.complete)


def _write(source: Path, target: Path) -> None:
    try:
        with target.open("xb") as file:
            _copy(Records(source), Writer(file, chunk_size=CHUNK_BYTES))
    except FileExistsError:
        raise RecordingError(f"{target}: exists already; recover under another name") from None
    except RecordingError:
        target.unlink()
        raise
    except OSError as error:
        target.unlink(missing_ok=True)
        raise RecordingError(f"{target}: cannot be written: {error.strerror}; recover to somewhere else") from error


def _copy(records: Records, writer: Writer) -> None:
    channels: dict[int, int] = {}
    schemas = {0: 0}  # MCAP's own mark for: none

    def channel_of(message: Message) -> int:
        if message.channel not in channels:
            old = records.channels[message.channel]
            if old.schema_id not in schemas and (schema := records.schemas.get(old.schema_id)):
                schemas[old.schema_id] = writer.register_schema(schema.name, schema.encoding, schema.data)
            channels[message.channel] = writer.register_channel(
                old.topic, old.message_encoding, schemas.get(old.schema_id, 0), old.metadata
            )
        return channels[message.channel]

    begun = False
    for message in records.messages():
        if not begun:
            _start(records, writer)
            begun = True
        writer.add_message(channel_of(message), message.logged, message.data, message.published, message.sequence)
    if not begun:
        _start(records, writer)
    for attachment in records.attachments:
        writer.add_attachment(
            attachment.create_time, attachment.log_time, attachment.name, attachment.media_type, attachment.data
        )
    for metadata in records.metadata:
        writer.add_metadata(metadata.name, metadata.metadata)
    writer.finish()  # type: ignore[no-untyped-call]


def _start(records: Records, writer: Writer) -> None:
    header = records.header
    writer.start(header.profile if header else "", header.library if header else "zenpark")


def _robot(channel: Channel) -> str:
    robot, _, what = channel.topic.removeprefix("/").partition("/")
    return robot if what and robot != WORLD else ""
