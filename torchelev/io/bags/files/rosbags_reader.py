"""Bags as rosbags reads them: whole, closed, and of ROS throughout."""

from __future__ import annotations

from collections.abc import Callable, Collection, Sequence
from pathlib import Path
from typing import Any

from torchelev.io.bags.files.decoding import deserializer, has_type
from torchelev.io.bags.files.definitions import make_typestore
from torchelev.io.bags.files.reader import Channel, Records


class RosbagsReader:
    """A `Reader` of a bag that rosbags opens.

    Raises:
        Exception: rosbags cannot open it; it lets through what its file formats raise.
        ModuleNotFoundError: rosbags is missing.
    """

    ending = ""

    def __init__(self, path: Path) -> None:
        from rosbags.highlevel import AnyReader

        # Bags of ROS 2 before Iron hold no definitions of their messages.
        self._reader: Any = AnyReader([path], default_typestore=make_typestore(2))
        self._reader.open()
        # A type without a definition may be one of ROS's own.
        self._default = make_typestore(2 if self._reader.is2 else 1)
        self._connections = {self._channel(found): found for found in self._reader.connections}
        self.channels: Sequence[Channel] = list(self._connections)
        times = (self._reader.start_time, self._reader.end_time - 1) if self._reader.message_count else None
        self.times: tuple[int, int] | None = times

    def messages(self, channels: Collection[Channel]) -> Records:
        """Yield the messages of channels in the order of their times."""
        by_type = {(channel.topic, channel.type): channel for channel in channels}
        for connection, time, raw in self._reader.messages([self._connections[channel] for channel in channels]):
            yield by_type[connection.topic, connection.msgtype], time, raw

    def close(self) -> None:
        """Close the files."""
        self._reader.close()

    def _channel(self, connection: Any) -> Channel:
        decode = self._decoder(connection.msgtype)
        problem = "its definition cannot be read" if connection.msgdef.data else "without a definition"
        problem = "" if decode else problem
        return Channel(connection.topic, connection.msgtype, connection.msgcount, decode, problem)

    def _decoder(self, msgtype: str) -> Callable[[bytes], Any] | None:
        stores = (self._reader.typestore, self._default)
        store = next((store for store in stores if has_type(store, msgtype)), None)
        return None if store is None else deserializer(store, msgtype, self._reader.is2)
