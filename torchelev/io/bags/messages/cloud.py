"""Points of a message, and errors and notes of messages that cannot be used, or only in part."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from torchelev.io.notes import Note


class CloudError(ValueError):
    """A message contradicts itself, or holds no points.

    Args:
        text: what is wrong, with the numbers of this message.
        kind: shared by all messages with the same problem; "": the text.
    """

    def __init__(self, text: str, kind: str = "") -> None:
        super().__init__(text)
        self.kind = kind or text


class Cloud(NamedTuple):
    """Points of a message."""

    points: NDArray[np.float32]  #: (N, 3) [m]; NaN where there is no return
    times: NDArray[np.float64] | None  #: (N,) [s] from the message's stamp; None: all at once
    notes: tuple[Note, ...] = ()  #: notes on data that are not used
    colors: NDArray[np.float32] | None = None  #: (N, 3) from 0 to 1; None: none, or not asked for
