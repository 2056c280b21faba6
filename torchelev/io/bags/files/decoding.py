"""Find how the messages of a channel are decoded: by the definition in the file, or as one of ROS's own types."""

from __future__ import annotations

import re
from collections.abc import Callable
from contextlib import suppress
from typing import Any, NamedTuple

from torchelev.io.bags.files.definitions import make_typestore
from torchelev.io.bags.files.foxglove import FOXGLOVE, make_foxglove_decoder

_ZSTD = b"\x28\xb5\x2f\xfd"
_SEPARATOR = re.compile(r"^=+\n", re.MULTILINE)
_INCLUDE = re.compile(r"^\s*#.*$|^IDL: .*$", re.MULTILINE)
_ENCODINGS = {"cdr": 2, "ros1": 1}


class Definition(NamedTuple):
    """What a file says about the messages of a channel."""

    type: str  #: name of the type
    encoding: str  #: of the messages: cdr, ros1, json, protobuf, ...
    format: str = ""  #: of the definition: ros2msg, ros2idl, ros1msg, protobuf, ...; "": there is none
    data: bytes = b""  #: the definition


class Decoding(NamedTuple):
    """How messages are decoded."""

    type: str  #: as which they are read
    decode: Callable[[bytes], Any] | None  #: None: they cannot be read
    problem: str = ""  #: why not


def find_decoding(definition: Definition) -> Decoding:
    """Return how the messages of a channel are decoded."""
    name, encoding = definition.type, definition.encoding
    if name.startswith("foxglove.") and encoding in ("protobuf", "json"):
        return _find_foxglove(definition)
    if encoding not in _ENCODINGS:
        return Decoding(name, None, f"encoded as {encoding or '(not named)'}")
    name = _full_name(name)
    for store in _typestores(definition, name):
        if has_type(store, name):
            return Decoding(name, deserializer(store, name, encoding == "cdr"))
    what = "its definition cannot be read" if definition.data else "without a definition"
    return Decoding(name, None, what)


def has_type(store: Any, name: str) -> bool:
    """Return whether rosbags' types hold a type and all those of its fields."""
    from rosbags.interfaces import Nodetype

    if name not in store.fielddefs:
        return False
    for _, (kind, value) in store.fielddefs[name][1]:
        while kind in (Nodetype.ARRAY, Nodetype.SEQUENCE):
            kind, value = value[0]
        if kind == Nodetype.NAME and not has_type(store, value):
            return False
    return True


def deserializer(store: Any, name: str, is_cdr: bool) -> Callable[[bytes], Any]:
    """Return the decoder of messages of a type in rosbags' types."""
    deserialize = store.deserialize_cdr if is_cdr else store.deserialize_ros1
    return lambda raw: deserialize(_unpacked(raw), name)


def _unpacked(raw: bytes) -> bytes:
    """Return a message that rosbag2 may have compressed by itself."""
    if bytes(raw[:4]) != _ZSTD:
        return raw
    from rosbags.rosbag2.reader import zstd

    return zstd.decompress(raw)


def _find_foxglove(definition: Definition) -> Decoding:
    if definition.type not in FOXGLOVE:
        return Decoding(definition.type, None, f"encoded as {definition.encoding}")
    try:
        decode = make_foxglove_decoder(definition.type, definition.encoding, definition.data)
    except ModuleNotFoundError:
        reason = "encoded as protobuf: install mcap-protobuf-support"
        return Decoding(definition.type, None, reason)
    except Exception as error:  # whatever protobuf raises of a damaged definition
        return Decoding(definition.type, None, f"its definition in protobuf cannot be read: {error}")
    return Decoding(FOXGLOVE[definition.type], decode)


def _full_name(name: str) -> str:
    """Return the name of a type as rosbags has it: ROS 1 says sensor_msgs/PointCloud2."""
    package, *rest = name.split("/")
    return f"{package}/msg/{rest[0]}" if len(rest) == 1 else name


def _typestores(definition: Definition, name: str) -> list[Any]:
    """Return the types of a definition, and ROS's own."""
    from rosbags.typesys import Stores, get_typestore

    stores = []
    if definition.data:
        with suppress(Exception):  # whatever the parsers raise: ROS's own type may fit
            store = get_typestore(Stores.EMPTY)
            store.register(_parse(definition, name))
            stores.append(store)
    return [*stores, make_typestore(_ENCODINGS[definition.encoding])]


def _parse(definition: Definition, name: str) -> Any:
    """Return rosbags' types of a definition; those that it includes stand behind it, after lines of =."""
    from rosbags.typesys import get_types_from_idl, get_types_from_msg

    text = definition.data.decode()
    if definition.format in ("ros2msg", "ros1msg"):
        return get_types_from_msg(text, name)
    types: dict[str, Any] = {}
    for part in _SEPARATOR.split(text):
        plain = _INCLUDE.sub("", part)
        if plain.strip():
            types.update(get_types_from_idl(plain))
    return types
