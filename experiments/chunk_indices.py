"""Where the chunks of a recording begin, kept on the disk until its end: hours of them do not fit into little memory.

`mcap` keeps an object for each chunk, with a table of the topics in it: 250 MB in an hour of 20 robots.
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from tempfile import TemporaryFile
from typing import Final

from mcap.data_stream import RecordBuilder
from mcap.records import ChunkIndex
from mcap.writer import Writer

BLOCK_BYTES: Final = 1024 * 1024
PRIVATE: Final = "_Writer__chunk_indices"  # as of mcap 1.6; the library has no public place for it


class Block:
    """Some indices as they stand in the file."""

    def __init__(self, data: bytes) -> None:
        self._data = data

    def write(self, stream: RecordBuilder) -> None:
        """Adds them to the summary."""
        stream.write(self._data)


class ChunkIndices:
    """Stands where the writer has a list: it appends, and goes through it once, at the end."""

    def __init__(self, folder: Path) -> None:
        """The file without a name is in `folder`, and gone with the process."""
        self._kept = TemporaryFile(dir=folder)  # noqa: SIM115 - closed by `close`

    def stand_in(self, writer: Writer) -> None:
        """Takes the place of a new writer's list.

        Raises:
            AttributeError: If this version of the library has none of that name.
        """
        if getattr(writer, PRIVATE):
            raise ValueError("the writer has begun already")
        setattr(writer, PRIVATE, self)

    def append(self, index: ChunkIndex) -> None:
        """One more chunk.

        Raises:
            OSError: If the disk takes no more.
        """
        record = RecordBuilder()
        index.write(record)
        self._kept.write(record.end())  # type: ignore[no-untyped-call]

    def __iter__(self) -> Iterator[Block]:
        self._kept.seek(0)
        while block := self._kept.read(BLOCK_BYTES):
            yield Block(block)

    def close(self) -> None:
        """Lets the file go."""
        self._kept.close()
