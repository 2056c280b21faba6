"""Depth compressed by RVL, as compressed_depth_image_transport writes it.

Wilson, "Fast Lossless Depth Image Compression" (ISS 2017): runs of zeros and of other pixels take turns; a pixel is the
difference from the one before; numbers are groups of 3 bits, in 4 with one that says whether more follow.
"""

from __future__ import annotations

import struct

import numpy as np
from numpy.typing import NDArray

from torchelev.io.bags.messages.cloud import CloudError

_SIZE = struct.Struct("<II")  # width, height
_MAX_PIXELS = 1 << 28
_CUT = CloudError("the RVL of a depth image is cut short or damaged")


def decode_rvl(data: bytes) -> NDArray[np.uint16]:
    """Return the pixels (h, w) of an image, behind its width and height.

    Raises:
        CloudError: it is cut short or damaged.
    """
    if len(data) < _SIZE.size:
        raise _CUT
    width, height = _SIZE.unpack_from(data)
    if not 0 < width * height <= _MAX_PIXELS:
        raise _CUT
    numbers = _numbers(data[_SIZE.size :])
    places, deltas = _runs(numbers, width * height)
    image = np.zeros(width * height, np.int64)
    steps = numbers[deltas]
    image[places] = np.cumsum((steps >> 1) ^ -(steps & 1))
    if (image < 0).any() or (image > 0xFFFF).any():
        raise _CUT
    return image.astype(np.uint16).reshape(height, width)


def _numbers(data: bytes) -> NDArray[np.int64]:
    """Return the numbers in words of 32 bits, whose first nibble is the highest."""
    words = np.frombuffer(data[: len(data) // 4 * 4], "<u4")
    shifts = np.arange(28, -1, -4, dtype=np.uint32)
    nibbles = ((words[:, None] >> shifts) & 15).astype(np.int64).ravel()
    ends = np.flatnonzero(nibbles < 8)
    if not len(ends):
        raise _CUT
    nibbles = nibbles[: ends[-1] + 1]
    starts = np.concatenate([[0], ends[:-1] + 1])
    place = np.arange(len(nibbles)) - np.repeat(starts, np.diff(np.append(starts, len(nibbles))))
    if place.max() > 12:
        raise _CUT
    return np.add.reduceat((nibbles & 7) << (3 * place), starts)


def _runs(numbers: NDArray[np.int64], num_pixels: int) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Return the places of the pixels that are not zero, and of their differences among the numbers."""
    places, deltas = [np.zeros(0, np.int64)], [np.zeros(0, np.int64)]
    pixel, k = 0, 0
    while pixel < num_pixels:
        if k + 2 > len(numbers):
            raise _CUT
        pixel += int(numbers[k])
        num, k = int(numbers[k + 1]), k + 2
        if pixel + num > num_pixels or k + num > len(numbers):
            raise _CUT
        places.append(np.arange(pixel, pixel + num))
        deltas.append(np.arange(k, k + num))
        pixel, k = pixel + num, k + num
    return np.concatenate(places), np.concatenate(deltas)
