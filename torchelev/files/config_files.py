"""Files of settings: JSON or YAML, grouped by stage."""

from __future__ import annotations

import json
import math
import re
from pathlib import Path
from typing import Any

from torchelev.errors import require
from torchelev.files.output_files import atomic_file

VERSION_NAME, VERSION = "torchelev_config", 1  # of the format; files without it are of version 1
SCHEMA_NAME = "$schema"  # by which editors find the file that describes the settings


def read_settings(path: str | Path) -> dict[str, Any]:
    """Read a file's settings as nested dicts: JSON if its name ends in .json, else YAML.

    Raises:
        ValueError: the file cannot be read, or holds no settings by group.
    """
    path = Path(path)
    try:
        text = path.read_text(encoding="utf-8")
    except (OSError, UnicodeDecodeError) as error:
        raise ValueError(f"{path}: cannot be read ({error})") from error
    values = _parse_json(path, text) if path.suffix.lower() == ".json" else _parse_yaml(path, text)
    if not isinstance(values, dict | None):
        raise ValueError(f"{path}: expected settings grouped by stage, such as 'grid: {{resolution: 0.1}}'")
    return values or {}


def write_settings(path: str | Path, values: dict[str, Any]) -> None:
    """Write nested dicts as JSON, with the format's version. Infinities, which JSON lacks, become "inf" and "-inf".

    Raises:
        WriteError: the file cannot be written; an existing one is left as it was.
    """
    text = json.dumps({VERSION_NAME: VERSION, **to_json(values)}, indent=2, allow_nan=False) + "\n"
    with atomic_file(path) as file:
        file.write(text.encode())


def without_header(values: dict[str, Any]) -> dict[str, Any]:
    """Return settings without the format's version and schema; ValueError if it is another version."""
    version = values.get(VERSION_NAME, VERSION)
    is_known = version == VERSION and type(version) is int
    require(is_known, VERSION_NAME, f"must be {VERSION}", version, "read it with a newer torchelev")
    return {name: value for name, value in values.items() if name not in (VERSION_NAME, SCHEMA_NAME)}


def split_off_completion(values: dict[str, Any]) -> tuple[dict[str, Any], bool]:
    """Return settings without `completion`, a stage of older versions, and whether it was switched on."""
    return {name: value for name, value in values.items() if name != "completion"}, values.get("completion") is not None


def from_json(value: Any) -> Any:
    """Return the number that `to_json` wrote as a text; anything else as it is."""
    return float(value) if value in ("inf", "-inf") else value


def to_json(value: Any) -> Any:
    """Return nested values as JSON can hold them: infinities as "inf" and "-inf", tuples as lists."""
    if isinstance(value, dict):
        return {key: to_json(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [to_json(item) for item in value]
    return str(value) if isinstance(value, float) and math.isinf(value) else value


def _parse_json(path: Path, text: str) -> Any:
    def unique(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
        names = [name for name, _ in pairs]
        twice = next((name for name in names if names.count(name) > 1), None)
        if twice is not None:
            raise ValueError(f"{twice!r} twice")
        return dict(pairs)

    def refuse(constant: str) -> Any:
        raise ValueError(f"{constant}, which is no JSON: write 'inf' in quotes")

    try:
        return json.loads(text, object_pairs_hook=unique, parse_constant=refuse)
    except (ValueError, RecursionError) as error:
        raise ValueError(f"{path}: cannot be read as JSON ({error})") from error


def _parse_yaml(path: Path, text: str) -> Any:
    import yaml  # maps in Python need none

    class Loader(yaml.SafeLoader):
        """Also read 1e-4 as a number; YAML 1.1 requires a decimal point and would read text."""

    number = re.compile(r"^[-+]?(\d+\.?\d*|\.\d+)[eE][-+]?\d+$")
    Loader.add_implicit_resolver("tag:yaml.org,2002:float", number, list("-+.0123456789"))
    try:
        return yaml.load(text, Loader)
    except yaml.YAMLError as error:
        raise ValueError(f"{path}: cannot be read as YAML ({error})") from error
