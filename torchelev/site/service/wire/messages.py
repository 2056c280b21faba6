"""The bytes of a message: a signature, a header in JSON, and compressed arrays. Nothing is ever unpickled.

```
4 bytes   b"TEVS"
2 bytes   VERSION, little-endian
32 bytes  HMAC-SHA256 of all that follows, or zeros
4 bytes   length of the header
header    JSON, with the lengths of the arrays under "bytes", in their order
arrays    zlib, little-endian; masks as bits
```

Which arrays there are, and of which shapes, is known to the reader from the header's kind and sizes: an array that
decompresses to anything else is refused before more than its size is in memory.
"""

from __future__ import annotations

import hashlib
import hmac
import json
import math
import struct
import zlib
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

MAGIC, VERSION = b"TEVS", 1
MAX_HEADER, MAX_MESSAGE, MAX_ARRAYS = 1 << 18, 1 << 25, 1 << 27  # bytes: header, message, decompressed arrays
_PREFIX = struct.Struct("<4sH32sI")
_UNSIGNED = bytes(32)
_LEVEL = 1  # of zlib: others take several times as long and save a tenth

Layout = Sequence[tuple[str, str, tuple[int, ...]]]  # name, NumPy's type, shape


class MessageError(ValueError):
    """A message is damaged, too large, or of something else; nothing of it was used."""


class OtherVersionError(MessageError):
    """A message is of another version of the protocol."""


class Message(NamedTuple):
    """A message whose header has been read, and whose arrays have not."""

    header: dict[str, Any]  #: JSON values
    signature: bytes  #: 32 bytes
    signed: bytes  #: what the signature is of
    body: bytes  #: the compressed arrays

    def is_signed_with(self, key: bytes) -> bool:
        """Return whether the message was signed with this key."""
        return hmac.compare_digest(self.signature, _sign(self.signed, key))

    def arrays(self, layout: Layout) -> dict[str, NDArray]:
        """Return the arrays of a layout; MessageError if the message holds others."""
        lengths = self.header.get("bytes")
        is_list = isinstance(lengths, list) and len(lengths) == len(layout) and all(map(_is_count, lengths))
        lengths = lengths if is_list and isinstance(lengths, list) else []
        _require(is_list and sum(lengths) == len(self.body), "arrays of other lengths")
        total = sum(_num_bytes(dtype, shape) for _, dtype, shape in layout)
        _require(total <= MAX_ARRAYS, f"arrays of {total} bytes, more than {MAX_ARRAYS}")
        found, start = {}, 0
        for (name, dtype, shape), length in zip(layout, lengths, strict=True):
            found[name] = _decompress(self.body[start : start + length], name, dtype, shape)
            start += length
        return found


def encode(
    header: Mapping[str, Any],
    layout: Layout = (),
    arrays: Mapping[str, NDArray] | None = None,
    key: bytes | None = None,
) -> bytes:
    """Return a message with these arrays, signed with a key if one is given."""
    parts = [_compress((arrays or {})[name], dtype) for name, dtype, _ in layout]
    text = json.dumps({**header, "bytes": [len(part) for part in parts]}, allow_nan=False).encode()
    signed = b"".join([text, *parts])
    signature = _UNSIGNED if key is None else _sign(signed, key)
    message = _PREFIX.pack(MAGIC, VERSION, signature, len(text)) + signed
    if len(message) > MAX_MESSAGE:
        rule = f"must have at most {MAX_MESSAGE} bytes, got {len(message)}"
        raise MessageError(f"message: {rule}; send fewer or smaller windows")
    return message


def decode(payload: bytes) -> Message:
    """Return a message whose arrays are still compressed; MessageError if it is none."""
    _require(_PREFIX.size <= len(payload) <= MAX_MESSAGE, f"{len(payload)} bytes")
    magic, version, signature, length = _PREFIX.unpack_from(payload)
    _require(magic == MAGIC, "no message of a site")
    if version != VERSION:
        raise OtherVersionError(f"message: must be of version {VERSION}, got {version}; install the same torchelev")
    end = _PREFIX.size + length
    _require(length <= MAX_HEADER and end <= len(payload), f"a header of {length} bytes")
    try:
        header = json.loads(payload[_PREFIX.size : end])
    except (ValueError, RecursionError) as error:
        raise MessageError("message: must have a header in JSON, got something else; is it damaged?") from error
    _require(isinstance(header, dict), "a header that is no object")
    return Message(header, signature, payload[_PREFIX.size :], payload[end:])


def take_text(header: Mapping[str, Any], name: str, longest: int = 200) -> str:
    """Return a text of a header; MessageError if there is none."""
    value = header.get(name)
    _require(isinstance(value, str) and len(value) <= longest, f"no {name}")
    return str(value)


def take_count(header: Mapping[str, Any], name: str, highest: int = 1 << 53) -> int:
    """Return a number from 0 on of a header; MessageError if there is none."""
    value = header.get(name)
    if not isinstance(value, int) or not _is_count(value) or value > highest:
        raise MessageError(f"message: must have {name} up to {highest}, got {value!r:.50}; is it damaged?")
    return value


def _is_count(value: object) -> bool:
    return isinstance(value, int) and not isinstance(value, bool) and value >= 0


def _sign(signed: bytes, key: bytes) -> bytes:
    return hmac.digest(key, signed, hashlib.sha256)


def _num_bytes(dtype: str, shape: tuple[int, ...]) -> int:
    number = math.prod(shape)
    return -(-number // 8) if dtype == "bool" else number * np.dtype(dtype).itemsize


def _compress(values: NDArray, dtype: str) -> bytes:
    """Return compressed values. Bytes of equal weight stand together, as neighbours share their high ones."""
    if dtype == "bool":
        return zlib.compress(np.packbits(values.astype(bool)).tobytes(), _LEVEL)
    numbers = np.ascontiguousarray(values, np.dtype(dtype).newbyteorder("<"))
    return zlib.compress(numbers.view(np.uint8).reshape(-1, numbers.itemsize).T.tobytes(), _LEVEL)


def _decompress(part: bytes, name: str, dtype: str, shape: tuple[int, ...]) -> NDArray:
    size, number = _num_bytes(dtype, shape), math.prod(shape)
    unzip = zlib.decompressobj()
    try:
        raw = unzip.decompress(part, size) if size else b""
        rest = unzip.decompress(unzip.unconsumed_tail, 1) if size else b""
    except zlib.error as error:
        raise MessageError(f"message: {name} must be compressed, got damaged bytes; it is sent again") from error
    _require(len(raw) == size and not rest, f"{name} of another size than {shape}")
    if dtype == "bool":
        return np.unpackbits(np.frombuffer(raw, np.uint8), count=number).astype(bool).reshape(shape)
    kind = np.dtype(dtype).newbyteorder("<")
    columns = np.frombuffer(raw, np.uint8).reshape(kind.itemsize, -1)
    values = np.ascontiguousarray(columns.T).view(kind).reshape(shape).astype(dtype)
    _require(kind.kind != "f" or not np.isinf(values).any(), f"{name} that is not finite")
    return values


def _require(holds: bool, actual: str) -> None:
    if not holds:
        raise MessageError(f"message: must be one of a site's service, got {actual}; is it damaged?")
