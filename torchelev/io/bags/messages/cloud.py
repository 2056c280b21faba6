"""Points of a message, and why a message cannot be used, or not fully."""

from __future__ import annotations

from collections import Counter
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray


class CloudError(ValueError):
    """A message contradicts itself, or holds no points.

    Args:
        text: what is wrong, with the numbers of this message.
        kind: the same for all messages of which the same is wrong; "": the text.
    """

    def __init__(self, text: str, kind: str = "") -> None:
        super().__init__(text)
        self.kind = kind or text


class Note(NamedTuple):
    """What is not used of a message, or used otherwise than it says."""

    text: str  #: with the numbers of this message
    kind: str  #: the same for all messages of which the same is said


class Cloud(NamedTuple):
    """Points of a message."""

    points: NDArray[np.float32]  #: (N, 3) [m]; NaN where there is no return
    times: NDArray[np.float64] | None  #: (N,) [s] from the message's stamp; None: all at once
    notes: tuple[Note, ...] = ()  #: what is not used of it


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
