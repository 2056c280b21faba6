"""The interface that `Bag` needs of a reader of files."""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterator, Sequence
from typing import Any, NamedTuple, Protocol


class Channel(NamedTuple):
    """Messages of one topic and type."""

    topic: str  #: such as "/lidar/points"
    type: str  #: type that they are read as, such as "sensor_msgs/msg/PointCloud2"; their own type if they are not read
    num: int  #: of messages
    decode: Callable[[bytes], Any] | None = None  #: returns a message of its bytes; None: they cannot be read
    problem: str = ""  #: why they cannot be read


Records = Iterator[tuple[Channel, int, bytes]]  # with the time [ns] and the serialised message


class Reader(Protocol):
    """Reads the messages of one file or several."""

    channels: Sequence[Channel]  #: also those that cannot be read
    times: tuple[int, int] | None  #: [ns] of the first message and the last; None: there is none
    ending: str  #: where and why reading stopped before the end; "" if it did not

    def messages(self, channels: Collection[Channel]) -> Records:
        """Yield the messages of channels in the order of their times."""

    def close(self) -> None:
        """Close the files."""
