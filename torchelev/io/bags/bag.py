"""Read the messages of a bag of any format."""

from __future__ import annotations

import contextlib
import itertools
from collections import Counter
from collections.abc import Iterator, Sequence
from contextlib import ExitStack
from pathlib import Path
from typing import Any, NamedTuple

from torchelev.io.bags.files.opening import SUFFIXES, bag_files, has_metadata, is_bag_file, open_reader
from torchelev.io.bags.files.reader import Channel
from torchelev.io.errors import RecordingError
from torchelev.io.folders.scan_files import has_clouds

__all__ = ["SUFFIXES", "Bag", "Message", "Topic", "is_bag"]


class Topic(NamedTuple):
    """A topic of a bag."""

    name: str  #: such as "/lidar/points"
    type: str  #: of its messages, such as "sensor_msgs/msg/PointCloud2"
    num: int  #: of messages
    problem: str = ""  #: why its messages cannot be read; "": they can


class Message(NamedTuple):
    """A message and its place in the bag."""

    topic: str  #: on which it was recorded
    time: float  #: [s] at which it was recorded
    data: Any  #: its fields


def is_bag(path: Path) -> bool:
    """Return whether a path is a bag: a file of a known suffix, or a folder of such files.

    Such a folder has the metadata.yaml of rosbag2, or files of messages and no scans beside them: the maps of
    `torchelev map --grid-map` may lie in a folder of scans.
    """
    if path.is_dir():
        return has_metadata(path) or (bool(bag_files(path)) and not has_clouds(path))
    return is_bag_file(path)


class Bag:
    """A bag: a file (`.bag` of ROS 1, `.mcap`, `.db3`), or a folder of the files of one recording.

    Use it in a `with` statement.

    Args:
        path: of the file or folder.

    Attributes:
        path: of the file or folder.

    Raises:
        RecordingError: the bag does not exist, or cannot be read.
        ModuleNotFoundError: rosbags is missing.
    """

    def __init__(self, path: str | Path) -> None:
        self.path = Path(path)
        self._stack, self._damage, self._undecoded = ExitStack(), "", Counter[str]()
        if not self.path.exists():
            raise RecordingError(self.path, "does not exist", "check the path")
        with ExitStack() as stack:
            try:
                self._reader = open_reader(self.path, stack)
            except (ModuleNotFoundError, RecordingError):
                raise
            except Exception as error:  # rosbags lets through what its file formats raise
                reason = f"cannot be read as a bag: {_describe(error)}"
                raise RecordingError(self.path, reason, _hint(self.path)) from error
            self._stack = stack.pop_all()

    def __enter__(self) -> Bag:
        return self

    def __exit__(self, *exception: object) -> None:
        self.close()

    def close(self) -> None:
        """Close the file."""
        self._stack.close()

    @property
    def ended_early(self) -> str:
        """Which part of the bag could not be read and why; "" if everything was read."""
        undecoded = [f"{num} messages could not be decoded: {reason}" for reason, num in self._undecoded.items()]
        return "; ".join(filter(None, [self._damage or self._reader.ending, *undecoded]))

    @property
    def topics(self) -> list[Topic]:
        """The topics whose messages can be read, by name."""
        return _list_topics([channel for channel in self._reader.channels if channel.decode])

    @property
    def unread(self) -> list[Topic]:
        """The topics whose messages cannot be read, by name."""
        return _list_topics([channel for channel in self._reader.channels if not channel.decode])

    @property
    def start(self) -> float:
        """When the first message was recorded [s]."""
        return self._reader.times[0] / 1e9 if self._reader.times else 0.0

    @property
    def duration(self) -> float:
        """Time between the first message and the last [s]."""
        start, end = self._reader.times or (0, 0)
        return max(0.0, (end - start) / 1e9)

    def read(self, topics: Sequence[str]) -> Iterator[Message]:
        """Read the messages of some topics in the order of their recording, one at a time.

        A damaged bag ends at the damage, see `ended_early`. Messages that cannot be decoded are left out.
        """
        channels = self._channels(topics)
        if not channels:
            return
        messages, last, num = self._reader.messages(channels), None, 0
        self._undecoded.clear()
        while True:
            try:
                channel, time, raw = next(messages)
            except StopIteration:
                self._require_all(channels, num)
                return
            except Exception as error:  # rosbags lets through what its file formats raise
                self._damage = f"the bag is damaged, and was {self._describe_place(last)}: {_describe(error)}"
                return
            last, num = time, num + 1
            if (data := self._decode(channel, raw)) is not None:
                yield Message(channel.topic, time / 1e9, data)

    def read_times(self, topic: str, count: int) -> list[float]:
        """Return when the first messages of a topic were recorded [s], at most `count`; a damaged bag gives fewer."""
        times: list[float] = []
        with contextlib.suppress(Exception):  # rosbags passes on exceptions of its file formats; `read` describes them
            for _, time, _ in itertools.islice(self._reader.messages(self._channels([topic])), count):
                times.append(time / 1e9)
        return times

    def _channels(self, topics: Sequence[str]) -> list[Channel]:
        return [channel for channel in self._reader.channels if channel.topic in topics and channel.decode]

    def _decode(self, channel: Channel, raw: bytes) -> Any:
        """Return a message; None, and counted, if its bytes are not those of its type."""
        try:
            return channel.decode(raw) if channel.decode else None
        except Exception as error:  # whatever libraries raise
            self._undecoded[f"{channel.topic}, {_describe(error)}"] += 1
            return None

    def _describe_place(self, time: int | None) -> str:
        return "not read" if time is None else f"read up to {time / 1e9 - self.start:.1f} s after its start"

    def _require_all(self, channels: Sequence[Channel], num: int) -> None:
        """Record damage if the bag counts more messages than could be read: its index is damaged."""
        expected = sum(channel.num for channel in channels)
        if num < expected and not self.ended_early:
            self._damage = f"the bag is damaged: {expected - num} of {expected} messages are missing"


def _list_topics(channels: Sequence[Channel]) -> list[Topic]:
    topics: dict[str, Topic] = {}
    for channel in sorted(channels, key=lambda channel: channel.topic):
        before = topics.get(channel.topic, Topic(channel.topic, channel.type, 0, channel.problem))
        kind = channel.type if before.type == channel.type else "several types"
        topics[channel.topic] = before._replace(type=kind, num=before.num + channel.num)
    return list(topics.values())


def _describe(error: Exception) -> str:
    """Return what an error says, in one line."""
    return " ".join(str(error).split()) or type(error).__name__


def _hint(path: Path) -> str:
    if path.suffix == ".db3" or (path.is_dir() and any(file.suffix == ".db3" for file in bag_files(path))):
        return "a database that was cut is repaired by `sqlite3 BAG.db3 .recover | sqlite3 REPAIRED.db3`"
    return "give a .bag, .mcap or .db3 file, or a folder with metadata.yaml"
