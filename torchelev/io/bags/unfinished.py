"""Bags that were not closed, as after a crash or a full disk: without an index, read from the start to the last record.

Records are read by rosbags (ROS 1), mcap and sqlite3. `UnfinishedBag` has what `Bag` uses of rosbags' AnyReader.
"""

from __future__ import annotations

import contextlib
import io
import sqlite3
from collections import Counter
from collections.abc import Callable, Collection, Iterator
from pathlib import Path
from typing import Any, NamedTuple

from torchelev.io.bags.definitions import make_typestore


class _Connection(NamedTuple):
    """A topic, its type, and the type's definition."""

    topic: str
    msgtype: str
    definition: str


class _Info(NamedTuple):
    """What `AnyReader.topics` says of a topic."""

    msgtype: str
    msgcount: int


_Records = Iterator[tuple[_Connection, int, bytes]]  # with the time [ns] and the serialised message


class UnfinishedBag:
    """A bag without an index. Its messages come in the order in which they were written.

    Args:
        path: a `.bag`, `.mcap` or `.db3` file.

    Attributes:
        ending: says how far the bag could be read.

    Raises:
        ValueError: it is another kind of file, or not one message can be read.
    """

    def __init__(self, path: Path) -> None:
        from rosbags.typesys import get_types_from_msg

        self._path, self._is1, self._records = path, path.suffix == ".bag", _RECORDS[path.suffix]
        self._counts: Counter[_Connection] = Counter()
        times: list[int] = []
        for connection, time, _ in self._read():
            self._counts[connection] += 1
            times = [min([time, *times]), max([time, *times])]
        if not times:
            raise ValueError("no message can be read")
        self.start_time, self.duration = times[0], times[1] - times[0]
        self.ending = f"the bag was not closed: read up to {self.duration / 1e9:.1f} s after its start"
        self.typestore = make_typestore(1 if self._is1 else 2)
        for connection in self._counts:
            if connection.definition:
                self.typestore.register(get_types_from_msg(connection.definition, connection.msgtype))

    @property
    def connections(self) -> list[_Connection]:
        """The topics with their types."""
        return list(self._counts)

    @property
    def topics(self) -> dict[str, _Info]:
        """Type and number of messages of each topic."""
        return {connection.topic: _Info(connection.msgtype, number) for connection, number in self._counts.items()}

    @property
    def message_count(self) -> int:
        """Number of messages that can be read."""
        return sum(self._counts.values())

    def messages(self, connections: Collection[_Connection]) -> _Records:
        """Yield topic, time [ns] and serialised message."""
        return (record for record in self._read() if record[0] in connections)

    def deserialize(self, raw: bytes, msgtype: str) -> Any:
        """Return a message."""
        store = self.typestore
        return store.deserialize_ros1(raw, msgtype) if self._is1 else store.deserialize_cdr(raw, msgtype)

    def _read(self) -> _Records:
        """Yield the records up to the first that cannot be read."""
        try:
            yield from self._records(self._path)
        except Exception:  # whatever the file formats raise where a file is cut
            return


def _read_database(path: Path) -> _Records:
    """Yield the rows of a database; types that ROS 2 does not have are unknown."""
    with contextlib.closing(sqlite3.connect(f"{path.resolve().as_uri()}?mode=ro&immutable=1", uri=True)) as database:
        database.execute("PRAGMA writable_schema=ON")  # or sqlite refuses a file shorter than its header says
        topics = database.execute("SELECT id, name, type FROM topics").fetchall()
        connections = {number: _Connection(name, kind, "") for number, name, kind in topics}
        for number, time, data in database.execute("SELECT topic_id, timestamp, data FROM messages NOT INDEXED"):
            yield connections[number], time, data


def _read_mcap(path: Path) -> _Records:
    with path.open("rb") as file:
        yield from _read_mcap_records(file)


def _read_mcap_records(file: io.BufferedIOBase) -> _Records:
    from mcap.records import Channel, Message, Schema
    from mcap.stream_reader import StreamReader

    schemas: dict[int, Schema] = {}
    connections: dict[int, _Connection] = {}
    for record in StreamReader(file).records:  # type: ignore[arg-type]
        if isinstance(record, Schema) and record.encoding == "ros2msg":
            schemas[record.id] = record
        elif isinstance(record, Channel) and record.schema_id in schemas:
            schema = schemas[record.schema_id]
            connections[record.id] = _Connection(record.topic, schema.name, schema.data.decode())
        elif isinstance(record, Message) and record.channel_id in connections:
            yield connections[record.channel_id], record.log_time, record.data


def _read_ros1(path: Path) -> _Records:
    with path.open("rb") as file:
        yield from _read_ros1_records(file)


def _read_ros1_records(file: io.BufferedIOBase) -> _Records:
    from rosbags.rosbag1.reader import Header, RecordType, decompressors

    if file.readline() != b"#ROSBAG V2.0\n":
        raise ValueError("not a bag of ROS 1")
    connections: dict[int, _Connection] = {}
    while True:
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
    return _Connection(header.get_string("topic"), f"{package}/msg/{name}", fields.get_string("message_definition"))


def _read_sized(file: io.BufferedIOBase) -> bytes:
    """Return the data of a record, behind its length."""
    size = int.from_bytes(_read_exactly(file, 4), "little")
    return _read_exactly(file, size)


def _read_exactly(file: io.BufferedIOBase, size: int) -> bytes:
    data = file.read(size)
    if len(data) < size:
        raise EOFError
    return data


_RECORDS: dict[str, Callable[[Path], _Records]] = {".bag": _read_ros1, ".mcap": _read_mcap, ".db3": _read_database}
