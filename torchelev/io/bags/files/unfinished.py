"""Bags without an index, as after a crash or a full disk: read from the start to the last whole record.

Records are read by rosbags (ROS 1), mcap and sqlite3. Closed MCAP files without an index are read in this way, too.
"""

from __future__ import annotations

import contextlib
import io
import sqlite3
from collections import Counter
from collections.abc import Callable, Collection, Iterator, Sequence
from pathlib import Path
from typing import Any, NamedTuple

from torchelev.io.bags.files.decoding import Definition, find_decoding
from torchelev.io.bags.files.mcap_reader import define, is_closed
from torchelev.io.bags.files.reader import Channel, Records


class _Connection(NamedTuple):
    """A topic, and the type of its messages."""

    topic: str
    definition: Definition


_RawRecords = Iterator[tuple[_Connection, int, bytes]]  # with the time [ns] and the serialised message


class UnfinishedReader:
    """A `Reader` of a file without an index. Its messages come in the order in which they were written.

    Args:
        path: a `.bag`, `.mcap` or `.db3` file.

    Raises:
        ValueError: it is another kind of file, or not one message can be read.
    """

    def __init__(self, path: Path) -> None:
        self._path, self._records, self._error = path, _RECORDS[path.suffix], ""
        counts: Counter[_Connection] = Counter()
        first, last = 0, 0
        for connection, time, _ in self._read():
            first, last = (min(first, time), max(last, time)) if counts else (time, time)
            counts[connection] += 1
        if not counts:
            raise ValueError("no message can be read")
        self.times: tuple[int, int] | None = (first, last)
        self.ending = self._describe_ending((last - first) / 1e9)
        self._channels = {connection: _make_channel(connection, num) for connection, num in counts.items()}
        self.channels: Sequence[Channel] = list(self._channels.values())

    def messages(self, channels: Collection[Channel]) -> Records:
        """Yield the messages of channels."""
        for connection, time, raw in self._read():
            if (channel := self._channels[connection]) in channels:
                yield channel, time, raw

    def close(self) -> None:
        """Nothing is kept open between readings."""

    def _read(self) -> _RawRecords:
        """Yield the records up to the first that cannot be read."""
        self._error = ""
        try:
            yield from self._records(self._path)
        except Exception as error:  # whatever the file formats raise where a file is cut
            self._error = " ".join(str(error).split()) or type(error).__name__

    def _describe_ending(self, seconds: float) -> str:
        """Return the time [s] up to which a file without a proper end could be read."""
        upto = f"read up to {seconds:.1f} s after its start"
        if not _HAS_END[self._path.suffix](self._path):
            return f"the bag was not closed: {upto}"
        return f"the bag is damaged, and was {upto}: {self._error}" if self._error else ""


def _make_channel(connection: _Connection, num: int) -> Channel:
    type_, decode, problem = find_decoding(connection.definition)
    return Channel(connection.topic, type_, num, decode, problem)


def _read_database(path: Path) -> _RawRecords:
    """Yield the rows of a database."""
    with contextlib.closing(sqlite3.connect(f"{path.resolve().as_uri()}?mode=ro&immutable=1", uri=True)) as database:
        database.execute("PRAGMA writable_schema=ON")  # or sqlite refuses a file shorter than its header says
        topics = database.execute("SELECT id, name, type, serialization_format FROM topics").fetchall()
        types = _database_types(database)
        connections = {
            number: _Connection(name, Definition(kind, encoding, *types.get(kind, ("", b""))))
            for number, name, kind, encoding in topics
        }
        for number, time, data in database.execute("SELECT topic_id, timestamp, data FROM messages NOT INDEXED"):
            yield connections[number], time, data


def _database_types(database: sqlite3.Connection) -> dict[str, tuple[str, bytes]]:
    """Return format and text of the definitions, by type; before Iron there are none."""
    query = "SELECT topic_type, encoding, encoded_message_definition FROM message_definitions"
    with contextlib.suppress(sqlite3.Error):
        return {name: (encoding, text.encode()) for name, encoding, text in database.execute(query)}
    return {}


def _read_mcap(path: Path) -> _RawRecords:
    with path.open("rb") as file:
        yield from _read_mcap_records(file)


def _read_mcap_records(file: io.BufferedIOBase) -> _RawRecords:
    from mcap.records import Channel as McapChannel
    from mcap.records import Message, Schema
    from mcap.stream_reader import StreamReader

    schemas: dict[int, Schema] = {}
    connections: dict[int, _Connection] = {}
    for record in StreamReader(file).records:  # type: ignore[arg-type]
        if isinstance(record, Schema):
            schemas[record.id] = record
        elif isinstance(record, McapChannel) and record.id not in connections:
            connections[record.id] = _Connection(record.topic, define(record, schemas.get(record.schema_id)))
        elif isinstance(record, Message) and record.channel_id in connections:
            yield connections[record.channel_id], record.log_time, record.data


def _read_ros1(path: Path) -> _RawRecords:
    with path.open("rb") as file:
        yield from _read_ros1_records(file)


def _read_ros1_records(file: io.BufferedReader) -> _RawRecords:
    from rosbags.rosbag1.reader import Header, RecordType, decompressors

    if file.readline() != b"#ROSBAG V2.0\n":
        raise ValueError("not a bag of ROS 1")
    connections: dict[int, _Connection] = {}
    while file.peek(1):
        header = Header.read(file)  # type: ignore[arg-type]
        data = _read_sized(file)
        if header.get_uint8("op") != RecordType.CHUNK:
            continue
        chunk = io.BytesIO(decompressors[header.get_string("compression")](data))
        while chunk.tell() < len(chunk.getbuffer()):
            inner = Header.read(chunk)
            number, data = inner.get_uint32("conn"), _read_sized(chunk)
            if inner.get_uint8("op") == RecordType.CONNECTION:
                connections[number] = _describe_ros1(inner, data, Header)
            elif number in connections:
                yield connections[number], inner.get_time("time"), data


def _describe_ros1(header: Any, data: bytes, header_type: Any) -> _Connection:
    fields = header_type.read(io.BytesIO(len(data).to_bytes(4, "little") + data))
    package, name = fields.get_string("type").split("/")
    definition = fields.get_string("message_definition").encode()
    return _Connection(header.get_string("topic"), Definition(f"{package}/msg/{name}", "ros1", "ros1msg", definition))


def _has_index(path: Path) -> bool:
    """Return whether a bag of ROS 1 reaches to its index, which is written when the bag is closed."""
    from rosbags.rosbag1.reader import Header

    with path.open("rb") as file:
        file.readline()
        index = Header.read(file).get_uint64("index_pos")
        return 0 < index <= path.stat().st_size


def _has_all_pages(path: Path) -> bool:
    """Return whether a database is as long as its header says."""
    with path.open("rb") as file:
        head = file.read(100)
    size, num = int.from_bytes(head[16:18], "big"), int.from_bytes(head[28:32], "big")
    return path.stat().st_size >= (65536 if size == 1 else size) * num > 0


def _read_sized(file: io.BufferedIOBase) -> bytes:
    """Return the data of a record, behind its length."""
    size = int.from_bytes(_read_exactly(file, 4), "little")
    return _read_exactly(file, size)


def _read_exactly(file: io.BufferedIOBase, size: int) -> bytes:
    data = file.read(size)
    if len(data) < size:
        raise EOFError
    return data


_RECORDS: dict[str, Callable[[Path], _RawRecords]] = {".bag": _read_ros1, ".mcap": _read_mcap, ".db3": _read_database}
_HAS_END: dict[str, Callable[[Path], bool]] = {".bag": _has_index, ".mcap": is_closed, ".db3": _has_all_pages}
