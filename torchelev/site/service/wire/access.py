"""Who may write: names and keys of robots. Without keys, any robot that reaches the merger may use any free name."""

from __future__ import annotations

import re
from collections.abc import Mapping
from pathlib import Path

from torchelev.errors import require
from torchelev.io.errors import RecordingError
from torchelev.site.service.wire.messages import Message, MessageError

_NAME = re.compile(r"[A-Za-z0-9][A-Za-z0-9_.-]{0,63}")
_SHORTEST = 16  # characters of a key


class ForbiddenError(Exception):
    """A robot may not send this. It is not answered: whoever has no key learns nothing."""


def check_name(argument: str, name: object) -> str:
    """Return a name of a robot or a site; ValueError if it is none."""
    is_name = isinstance(name, str) and _NAME.fullmatch(name) is not None
    require(is_name, argument, "must be 1 to 64 letters, digits, _ . or -", repr(name), "give spot-1, say")
    return str(name)


def check_key(argument: str, key: object) -> bytes:
    """Return a key as bytes; ValueError if it is too short."""
    is_text = isinstance(key, str) and len(key) >= _SHORTEST
    hint = "make one with: python -c 'import secrets; print(secrets.token_hex(32))'"
    actual = f"{len(key)} of them" if isinstance(key, str) else type(key).__name__
    require(is_text, argument, f"must be a text of at least {_SHORTEST} characters", actual, hint)
    return str(key).encode()


def check_keys(keys: Mapping[str, str] | None) -> dict[str, bytes] | None:
    """Return the keys of all robots that may write; None: all may."""
    if keys is None:
        return None
    return {check_name("robots", name): check_key(f"robots: key of {name}", key) for name, key in keys.items()}


def check_sender(message: Message, delivered_as: str | None, keys: Mapping[str, bytes] | None) -> str:
    """Return the robot whose message it is.

    Args:
        message: decoded.
        delivered_as: name of the robot under which the network delivered it; None: not known.
        keys: of the robots that may write; None: all may.

    Raises:
        MessageError: it names no robot.
        ForbiddenError: it names another one than the network does, or is not signed with that robot's key.
    """
    try:
        name = check_name("robot", message.header.get("robot"))
    except ValueError as error:
        raise MessageError(str(error)) from error
    if delivered_as is not None and delivered_as != name:
        raise ForbiddenError(f"{delivered_as} sent windows of {name}")
    key = None if keys is None else keys.get(name)
    if keys is not None and (key is None or not message.is_signed_with(key)):
        raise ForbiddenError(f"{name} has another key, or none")
    return name


def read_keys(path: Path) -> dict[str, str]:
    """Return the names and keys of a YAML file, one `name: key` per line.

    Raises:
        RecordingError: it cannot be read, holds anything else, or a key is too short.
    """
    import yaml

    try:
        content = yaml.safe_load(path.read_text())
    except (OSError, UnicodeDecodeError, yaml.YAMLError) as error:
        raise RecordingError(path, f"cannot be read ({error})", "give a YAML file") from error
    is_mapping = isinstance(content, dict) and all(isinstance(name, str) for name in content)
    if not is_mapping:
        raise RecordingError(path, "must hold a line for each robot", "write spot-1: and a key")
    keys = {name: str(key) for name, key in content.items()}
    try:
        check_keys(keys)
    except ValueError as error:
        raise RecordingError(path, str(error)) from error
    return keys
