"""Read several files of one recording as one."""

from __future__ import annotations

import heapq
import re
from collections import Counter
from collections.abc import Collection, Sequence
from pathlib import Path

from torchelev.io.bags.files.reader import Channel, Reader, Records

_MAX_GAP = 60e9  # [ns] between two parts of a recording without a warning


class JoinedReader:
    """A `Reader` of several: their messages by time.

    Args:
        readers: with the file that each of them reads.
        note: on the files, which becomes part of `ending`; "": none.
    """

    def __init__(self, readers: Sequence[tuple[Path, Reader]], note: str = "") -> None:
        self._readers = readers
        counts: Counter[tuple[str, str]] = Counter()
        found: dict[tuple[str, str], Channel] = {}
        for _, reader in readers:
            for channel in reader.channels:
                counts[channel.topic, channel.type] += channel.num
                found.setdefault((channel.topic, channel.type), channel)
        self.channels: Sequence[Channel] = [one._replace(num=counts[key]) for key, one in found.items()]
        times = [time for _, reader in readers for time in reader.times or ()]
        self.times = (min(times), max(times)) if times else None
        endings = [f"{file.name}: {reader.ending}" for file, reader in readers if reader.ending]
        self.ending = "; ".join([*([note] if note else []), *endings])

    def messages(self, channels: Collection[Channel]) -> Records:
        """Yield the messages of channels in the order of their times."""
        wanted = {(channel.topic, channel.type) for channel in channels}
        parts = (self._part(reader, wanted) for _, reader in self._readers)
        return heapq.merge(*parts, key=lambda record: record[1])  # with the channels of each file, which decode them

    def close(self) -> None:
        """Close the files."""
        for _, reader in self._readers:
            reader.close()

    @staticmethod
    def _part(reader: Reader, wanted: set[tuple[str, str]]) -> Records:
        channels = [channel for channel in reader.channels if (channel.topic, channel.type) in wanted]
        return reader.messages(channels) if channels else iter(())


def describe_gap(readers: Sequence[tuple[Path, Reader]]) -> str:
    """Return a sentence if there is a long gap between two parts, as one may be missing; else ""."""
    spans = sorted((reader.times, file.name) for file, reader in readers if reader.times)
    for (before, one), (after, other) in zip(spans, spans[1:], strict=False):
        if (gap := after[0] - before[1]) > _MAX_GAP:
            return f"between {one} and {other} nothing was recorded for {gap / 1e9:.0f} s: a file may be missing"
    return ""


def are_parts(readers: Sequence[tuple[Path, Reader]]) -> bool:
    """Return whether files are parts of one recording: names that differ in numbers only, or overlapping times."""
    names = {re.sub(r"[\d_.-]+", "", file.name) for file, _ in readers}
    spans = sorted(reader.times for _, reader in readers if reader.times)
    return len(names) == 1 or all(after[0] <= before[1] for before, after in zip(spans, spans[1:], strict=False))
