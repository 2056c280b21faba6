"""The bytes of messages, from any type that a library returns."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray


def as_bytes(data: Any) -> NDArray[np.uint8]:
    """Return the data of a message: of bytes, an array of bytes, or a sequence of numbers below 256."""
    if isinstance(data, bytes | bytearray | memoryview):
        return np.frombuffer(data, np.uint8)
    return np.ascontiguousarray(data, dtype=np.uint8)
