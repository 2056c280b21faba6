"""Read the messages of a bag, whatever its format."""

from __future__ import annotations

import contextlib
import itertools
from collections.abc import Iterator, Sequence
from contextlib import ExitStack
from pathlib import Path
from typing import Any, NamedTuple

from torchelev.io.bags.definitions import make_typestore
from torchelev.io.bags.unfinished import UnfinishedBag
from torchelev.io.errors import RecordingError
from torchelev.io.folders.scan_files import has_clouds

SUFFIXES = (".bag", ".mcap", ".db3")
_HEAD_BYTES = 4096  # of a metadata.yaml, which begin with its key


class Topic(NamedTuple):
    """A topic of a bag."""

    name: str  #: such as "/lidar/points"
    type: str  #: of its messages, such as "sensor_msgs/msg/PointCloud2"
    num: int  #: of messages


class Message(NamedTuple):
    """A message and its place in the bag."""

    topic: str  #: on which it was recorded
    time: float  #: [s] at which it was recorded
    data: Any  #: its fields


def is_bag(path: Path) -> bool:
    """Tell whether a path is a bag: a file of a known suffix, or a folder of ROS 2.

    Such a folder has the metadata.yaml of rosbag2, or files of messages and no scans beside them: the maps of
    `torchelev map --grid-map` may lie in a folder of scans.
    """
    if path.is_dir():
        return _has_metadata(path) or (bool(_storage_files(path)) and not has_clouds(path))
    return path.suffix in SUFFIXES


def _has_metadata(folder: Path) -> bool:
    """Tell whether a folder has the metadata.yaml of rosbag2; data sets have files of this name, too."""
    file = folder / "metadata.yaml"
    if not file.is_file():
        return False
    with file.open("rb") as opened:
        return b"rosbag2_bagfile_information" in opened.read(_HEAD_BYTES)


def _storage_files(folder: Path) -> list[Path]:
    return sorted(path for path in folder.iterdir() if path.suffix in (".mcap", ".db3"))


class Bag:
    """A bag: a ROS 1 file (`.bag`), or a ROS 2 folder or file (`.mcap`, `.db3`). Use it in a `with` statement.

    Args:
        path: of the file or folder.

    Attributes:
        path: of the file or folder.
        ended_early: says where and why reading stopped before the end of the bag; "" if it did not.

    Raises:
        RecordingError: the bag does not exist, or cannot be read.
        ModuleNotFoundError: rosbags is missing.
    """

    def __init__(self, path: str | Path) -> None:
        self.path = Path(path)
        self.ended_early = ""
        self._stack = ExitStack()
        if not self.path.exists():
            raise RecordingError(self.path, "does not exist", "check the path")
        try:
            self._reader = self._open()
        except ModuleNotFoundError:
            raise
        except Exception as error:  # rosbags lets through what its file formats raise
            raise RecordingError(self.path, f"cannot be read as a bag: {_describe(error)}", _hint(self.path)) from error

    def _open(self) -> Any:
        """Return a reader; of a bag that was not closed, one that reads up to where it ends."""
        file = _storage_file(self.path)
        try:
            return self._stack.enter_context(_make_reader(self.path if file is None else file))
        except ModuleNotFoundError:
            raise
        except Exception:
            files = [file or self.path] if not self.path.is_dir() or file else _storage_files(self.path)
            if len(files) != 1 or files[0].suffix not in SUFFIXES:
                raise
            try:
                unfinished = UnfinishedBag(files[0])
            except ValueError:
                pass
            else:
                self.ended_early = unfinished.ending
                return unfinished
            raise

    def __enter__(self) -> Bag:
        return self

    def __exit__(self, *exception: object) -> None:
        self.close()

    def close(self) -> None:
        """Close the file."""
        self._stack.close()

    @property
    def topics(self) -> list[Topic]:
        """The topics, by name."""
        topics = self._reader.topics.items()
        return [Topic(name, info.msgtype or "several types", info.msgcount) for name, info in sorted(topics)]

    @property
    def start(self) -> float:
        """When the first message was recorded [s]."""
        return self._reader.start_time / 1e9 if self._reader.message_count else 0.0

    @property
    def duration(self) -> float:
        """Time between the first message and the last [s]."""
        return max(0.0, self._reader.duration / 1e9) if self._reader.message_count else 0.0

    def read(self, topics: Sequence[str]) -> Iterator[Message]:
        """Read the messages of some topics in the order of their recording, one at a time.

        A bag that is damaged ends there, see `ended_early`.
        """
        connections = [connection for connection in self._reader.connections if connection.topic in topics]
        if not connections:
            return
        messages, last, num = self._reader.messages(connections), None, 0
        while True:
            try:
                connection, time, raw = next(messages)
                data = self._reader.deserialize(raw, connection.msgtype)
            except StopIteration:
                self._require_all(topics, num)
                return
            except Exception as error:  # rosbags lets through what its file formats raise
                read = "not read" if last is None else f"read up to {last - self.start:.1f} s after its start"
                self.ended_early = f"the bag is damaged, and was {read}: {_describe(error)}"
                return
            last, num = time / 1e9, num + 1
            yield Message(connection.topic, last, data)

    def read_times(self, topic: str, count: int) -> list[float]:
        """Return when the first messages of a topic were recorded [s], at most `count`; a damaged bag gives fewer."""
        connections = [connection for connection in self._reader.connections if connection.topic == topic]
        times: list[float] = []
        with contextlib.suppress(Exception):  # rosbags lets through what its file formats raise; `read` says what
            for _, time, _ in itertools.islice(self._reader.messages(connections), count):
                times.append(time / 1e9)
        return times

    def _require_all(self, topics: Sequence[str], num: int) -> None:
        """Say so if the bag counts more messages than could be read: its index is damaged."""
        expected = sum(topic.num for topic in self.topics if topic.name in topics)
        if num < expected and not self.ended_early:
            self.ended_early = f"the bag is damaged: {expected - num} of {expected} messages are missing"


def _storage_file(path: Path) -> Path | None:
    """Return the only file of messages in a folder without metadata.yaml, as a crash leaves one; else None."""
    if not path.is_dir() or _has_metadata(path):
        return None
    files = _storage_files(path)
    return files[0] if len(files) == 1 else None


def _make_reader(path: Path) -> Any:
    from rosbags.highlevel import AnyReader

    # Bags of ROS 2 before Iron hold no definitions of their messages.
    return AnyReader([path], default_typestore=make_typestore(2))


def _describe(error: Exception) -> str:
    """Return what an error says, in one line."""
    return " ".join(str(error).split()) or type(error).__name__


def _hint(path: Path) -> str:
    if path.suffix == ".db3" or (path.is_dir() and any(file.suffix == ".db3" for file in _storage_files(path))):
        return "a database that was cut is repaired by `sqlite3 BAG.db3 .recover | sqlite3 REPAIRED.db3`"
    return "give a .bag, .mcap or .db3 file, or a folder with metadata.yaml"
