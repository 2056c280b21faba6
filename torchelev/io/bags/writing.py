"""Write messages to a new bag: a .bag of ROS 1, or a .mcap, .db3 or folder of ROS 2."""

from __future__ import annotations

import shutil
import sqlite3
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np

from torchelev.errors import require
from torchelev.files.output_files import WriteError, require_writable
from torchelev.io.bags.files.definitions import make_typestore

_STORAGE = {".mcap": "MCAP", ".db3": "SQLITE3", "": "MCAP"}


class BagWriter:
    """Writes a bag, which appears at its path when it is closed. Use it in a `with` statement.

    Args:
        path: `.bag` for ROS 1; `.mcap` or `.db3` for a file of ROS 2; without suffix for a folder of ROS 2.

    Raises:
        ValueError: the path has another suffix.
        FileExistsError: there is a folder of this name.
        WriteError: the path cannot be written.
        ModuleNotFoundError: rosbags is missing.
    """

    def __init__(self, path: str | Path) -> None:
        self.path = Path(path)
        suffix, hint = self.path.suffix, "name it .bag for ROS 1, or .mcap for ROS 2"
        require(suffix == ".bag" or suffix in _STORAGE, "path", "must be a bag's", self.path.name, hint)
        if self.path.is_dir():
            raise FileExistsError(f"{self.path}: is a folder; choose another name")
        require_writable(self.path)
        self.ros = 1 if suffix == ".bag" else 2
        self.store = make_typestore(self.ros)
        self._folder = Path(tempfile.mkdtemp(prefix=f".{self.path.name}-", dir=self.path.resolve().parent))
        try:
            self._bag = self._open()
        except BaseException:
            shutil.rmtree(self._folder, ignore_errors=True)
            raise
        self._connections: dict[str, Any] = {}

    def _open(self) -> Any:
        if self.ros == 1:
            from rosbags.rosbag1 import Writer as Writer1

            bag: Any = Writer1(self._folder / "bag.bag")
        else:
            from rosbags.rosbag2 import StoragePlugin
            from rosbags.rosbag2 import Writer as Writer2

            plugin = StoragePlugin[_STORAGE[self.path.suffix]]
            bag = Writer2(self._folder / (self.path.stem or "bag"), version=9, storage_plugin=plugin)
        bag.open()
        return bag

    def __enter__(self) -> BagWriter:
        return self

    def __exit__(self, kind: type[BaseException] | None, *exception: object) -> None:
        if kind is None:
            self.close()
        else:
            self.discard()

    def make(self, type_: str, /, **fields: Any) -> Any:
        """Return a message of a type such as "geometry_msgs/msg/Point"."""
        return self.store.types[type_](**fields)

    def make_header(self, stamp: float, frame: str) -> Any:
        """Return a header; the stamp is in [s]."""
        seconds = int(np.floor(stamp))
        nanoseconds = min(round((stamp - seconds) * 1e9), 999_999_999)
        time = self.make("builtin_interfaces/msg/Time", sec=seconds, nanosec=nanoseconds)
        return self.make("std_msgs/msg/Header", stamp=time, frame_id=frame, **({"seq": 0} if self.ros == 1 else {}))

    def write(self, topic: str, type_: str, stamp: float, message: Any) -> None:
        """Append a message, recorded at a time [s]."""
        with self._full_disk_named():
            if topic not in self._connections:
                self._connections[topic] = self._bag.add_connection(topic, type_, typestore=self.store)
            self._bag.write(self._connections[topic], round(stamp * 1e9), self.serialize(message, type_))

    def serialize(self, message: Any, type_: str) -> bytes:
        """Return a message in the encoding of the bag: ROS 1's, or CDR."""
        serialize = self.store.serialize_ros1 if self.ros == 1 else self.store.serialize_cdr
        return bytes(serialize(message, type_))

    def close(self) -> None:
        """Finish the bag and move it to its path; a file that was there is replaced."""
        if not self._folder.exists():
            return
        try:
            with self._full_disk_named():
                self._bag.close()
            self._written().replace(self.path)
        finally:
            shutil.rmtree(self._folder, ignore_errors=True)

    def discard(self) -> None:
        """Leave the path as it was, as after an error in the `with` statement."""
        try:
            self._bag.close()
        finally:
            shutil.rmtree(self._folder, ignore_errors=True)

    @contextmanager
    def _full_disk_named(self) -> Iterator[None]:
        """Raise WriteError for SQLite's error of a full disk, which is not an OSError."""
        try:
            yield
        except sqlite3.Error as error:
            raise WriteError(self.path, str(error)) from error

    def _written(self) -> Path:
        """Return the file, or the folder, that was written."""
        if self.ros == 1:
            return self._folder / "bag.bag"
        folder = self._folder / (self.path.stem or "bag")
        return next(folder.glob(f"*{self.path.suffix}")) if self.path.suffix else folder
