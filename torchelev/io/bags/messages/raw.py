"""The bytes of messages, from any type that a library returns, and the pixels of images."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from torchelev.io.bags.messages.cloud import CloudError


def as_bytes(data: Any) -> NDArray[np.uint8]:
    """Return the data of a message: of bytes, an array of bytes, or a sequence of numbers below 256."""
    if isinstance(data, bytes | bytearray | memoryview):
        return np.frombuffer(data, np.uint8)
    return np.ascontiguousarray(data, dtype=np.uint8)


def read_pixels(message: Any, kind: str) -> NDArray:
    """Return the pixels (h, w) of an Image of one channel.

    Args:
        message: the image.
        kind: of a pixel, such as "u2".

    Raises:
        CloudError: there are too few bytes.
    """
    dtype = np.dtype((">" if message.is_bigendian else "<") + kind)
    data, (height, width, step) = as_bytes(message.data), map(int, (message.height, message.width, message.step))
    if len(data) == height * width * dtype.itemsize:  # drivers leave step 0, or as it was before a crop
        step = width * dtype.itemsize
    if step < width * dtype.itemsize or len(data) < step * (height - 1) + width * dtype.itemsize:
        raise CloudError(f"the image has {len(data)} bytes, too few for {height} rows of {step}", "too few bytes")
    return np.ndarray((height, width), dtype, buffer=data, strides=(step, dtype.itemsize))
