"""Depth out of compressed images: PNG of 16 bits or RVL, alone or behind the header of image_transport."""

from __future__ import annotations

import struct
import zlib

import numpy as np
from numpy.typing import NDArray

from torchelev.io.bags.messages.cloud import CloudError
from torchelev.io.bags.messages.rvl import decode_rvl

_SIGNATURE = b"\x89PNG\r\n\x1a\n"
_MAX_HEADER = 64  # [bytes] before the PNG
_QUANTISATION = struct.Struct("<iff")  # compression_common.h of image_transport_plugins: format, a and b


def decode_depth(data: bytes, encoding: str, scale: float | None = None) -> NDArray[np.float32]:
    """Return the depth (h, w) [m] of a CompressedImage, 0 where there is none.

    Of 32FC1, a pixel q is a / depth + b with the numbers a and b of the header.

    Args:
        data: of the message.
        encoding: the message's `format`.
        scale: metres per unit of depth; None: 0.001 of integers, and 1 of 32FC1.

    Raises:
        CloudError: it is neither a PNG of 16 bits nor RVL, or it is cut short or damaged.
    """
    start = _QUANTISATION.size if "rvl" in encoding.lower() else data.find(_SIGNATURE, 0, _MAX_HEADER)
    if start < 0:
        raise CloudError(f"compressed images of {encoding!r} hold no depth; PNG of 16 bits and RVL do")
    pixels = decode_rvl(data[start:]) if "rvl" in encoding.lower() else _decode(data[start:], encoding)
    if "32FC1" not in encoding:
        return pixels.astype(np.float32) * np.float32(1e-3 if scale is None else scale)
    return _dequantise(pixels, data[:start]) * np.float32(1.0 if scale is None else scale)


def _dequantise(pixels: NDArray[np.uint16], header: bytes) -> NDArray[np.float32]:
    """Return the depth of quantised pixels."""
    if len(header) != _QUANTISATION.size:
        size = len(header)
        raise CloudError(f"the compressed depth of 32FC1 has a header of {size} bytes; expected {_QUANTISATION.size}")
    _, a, b = _QUANTISATION.unpack(header)
    if not (a > 0 and np.isfinite([a, b]).all()):
        raise CloudError(f"the compressed depth of 32FC1 has the quantisation a = {a:g}, b = {b:g}; a must be positive")
    inverse = np.where(pixels > 0, pixels - np.float32(b), np.float32(-1))
    return np.where(inverse > 0, np.float32(a) / np.where(inverse > 0, inverse, np.float32(1)), np.float32(0))


def _decode(png: bytes, encoding: str) -> NDArray[np.uint16]:
    import cv2

    _require_whole(png)
    image = cv2.imdecode(np.frombuffer(png, np.uint8), cv2.IMREAD_UNCHANGED)
    if image is None:
        raise CloudError("the PNG of a depth image cannot be decoded")
    if image.dtype != np.uint16 or image.ndim != 2:
        raise CloudError(f"compressed images of {encoding!r} hold no depth; PNG of 16 bits and RVL do")
    return np.asarray(image, dtype=np.uint16)


def _require_whole(png: bytes) -> None:
    """Raise CloudError unless all chunks are there and have their checksums: OpenCV may fill what is missing with 0."""
    place = len(_SIGNATURE)
    while True:
        size = int.from_bytes(png[place : place + 4], "big")
        kind, end = png[place + 4 : place + 8], place + 12 + size
        if end > len(png):
            raise CloudError("the PNG of a depth image is cut short")
        if zlib.crc32(png[place + 4 : end - 4]) != int.from_bytes(png[end - 4 : end], "big"):
            raise CloudError("the PNG of a depth image is damaged: a checksum is wrong")
        if kind == b"IEND":
            return
        place = end
