"""MCAP files that rosbags refuses: with other encodings or profiles, or with definitions that it cannot read."""

from __future__ import annotations

from collections.abc import Collection, Sequence
from contextlib import ExitStack
from pathlib import Path
from typing import Any

from torchelev.io.bags.files.decoding import Definition, find_decoding
from torchelev.io.bags.files.reader import Channel, Records

MAGIC = b"\x89MCAP0\r\n"


class McapReader:
    """A `Reader` of a closed MCAP file with an index.

    Raises:
        ValueError: the file has no index.
        McapError: it is damaged.
    """

    ending = ""

    def __init__(self, path: Path) -> None:
        from mcap.reader import SeekingReader

        with ExitStack() as stack:
            file = stack.enter_context(path.open("rb"))
            self._reader = SeekingReader(file, validate_crcs=True)
            summary = self._reader.get_summary()
            if summary is None or summary.statistics is None or not summary.chunk_indexes:
                raise ValueError("the file has no index")
            self._stack = stack.pop_all()
        counts, schemas = summary.statistics.channel_message_counts, summary.schemas
        self._channels = {}
        for number, found in summary.channels.items():
            type_, decode, problem = find_decoding(define(found, schemas.get(found.schema_id)))
            self._channels[number] = Channel(found.topic, type_, counts.get(number, 0), decode, problem)
        self.channels: Sequence[Channel] = list(self._channels.values())
        start, end = summary.statistics.message_start_time, summary.statistics.message_end_time
        self.times = (start, end) if summary.statistics.message_count else None

    def messages(self, channels: Collection[Channel]) -> Records:
        """Yield the messages of channels in the order of their times."""
        topics = [channel.topic for channel in channels]
        for _, found, message in self._reader.iter_messages(topics):
            channel = self._channels[found.id]
            if channel in channels:
                yield channel, message.log_time, message.data

    def close(self) -> None:
        """Close the file."""
        self._stack.close()


def define(channel: Any, schema: Any | None) -> Definition:
    """Return what a file says about the messages of a channel; it may have no schema."""
    if schema is None:
        return Definition("unknown type", channel.message_encoding)
    return Definition(schema.name, channel.message_encoding, schema.encoding, schema.data)


def is_closed(path: Path) -> bool:
    """Return whether a file ends as a closed MCAP file does."""
    with path.open("rb") as file:
        size = file.seek(0, 2)
        file.seek(max(0, size - len(MAGIC)))
        return size > 2 * len(MAGIC) and file.read() == MAGIC
