"""Notes on data that are not used: one line per kind of note, with the number of scans."""

from __future__ import annotations

from collections import Counter
from typing import NamedTuple


class Note(NamedTuple):
    """A note on data of a scan that are not used, or are interpreted differently from their metadata."""

    text: str  #: with the numbers of this scan
    kind: str  #: the same for all scans of which the same is said


class Reasons(Counter[str]):
    """Counts reasons. Those of one kind are counted together, under the text of the first."""

    def __init__(self) -> None:
        super().__init__()
        self._texts: dict[str, str] = {}

    def count(self, text: str, kind: str = "") -> None:
        """Count a reason once more."""
        self[self._texts.setdefault(kind or text, text)] += 1

    def clear(self) -> None:
        """Forget all of them."""
        super().clear()
        self._texts.clear()
