"""The colours of points: which fields hold them, and how they are packed."""

from __future__ import annotations

from collections.abc import Collection, Sequence

import numpy as np
from numpy.typing import NDArray

_FIELDS = (("rgb",), ("rgba",), ("red", "green", "blue"), ("r", "g", "b"))


def color_fields(names: Collection[str]) -> tuple[str, ...]:
    """Return the fields that hold the colours of points: one that is packed, or three; () if there are none."""
    return next((fields for fields in _FIELDS if set(fields) <= set(names)), ())


def to_colors(columns: Sequence[NDArray]) -> NDArray[np.float32]:
    """Return colours (N, 3) from 0 to 1.

    Args:
        columns: one field (N,) of 4 bytes with the bits 0xAARRGGBB, of integers or of floats, as RViz and PCL have it;
            or red, green and blue: integers up to the largest of their type, or floats up to 1, or up to 255 if one is
            larger.

    Raises:
        ValueError: a packed field has another size.
    """
    if len(columns) == 1:
        (packed,) = columns
        if packed.dtype.itemsize != 4:
            raise ValueError(f"a field of packed colours has 4 bytes, got {packed.dtype}")
        bits = np.ascontiguousarray(packed).view(np.dtype("u4").newbyteorder(packed.dtype.byteorder))
        return np.stack([bits >> 16 & 255, bits >> 8 & 255, bits & 255], -1).astype(np.float32) / np.float32(255)
    values = np.stack(columns, -1)
    if values.dtype.kind in "iu":
        return values.astype(np.float32) / np.float32(np.iinfo(values.dtype).max)
    largest = np.nanmax(values, initial=0.0)
    return np.clip(values / (255.0 if largest > 1 else 1.0), 0, 1).astype(np.float32)
