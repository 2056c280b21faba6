"""Write the JSON schema of config files, with units and meanings: `python -m docs.config_schema`."""

from __future__ import annotations

import dataclasses
import json
import re
import types
import typing
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from docs.extensions.fields import comments
from torchelev.channels.config import DTYPES, KINDS, ChannelConfig
from torchelev.config import ElevationMapConfig, setting_types
from torchelev.files.config_files import SCHEMA_NAME, VERSION, VERSION_NAME, to_json
from torchelev.kernels.registry import PACKAGE

FILE = PACKAGE / "runtime" / "generated" / "map.schema.json"
_FILTERS = {
    "type": "array",
    "items": {
        "type": "object",
        "required": ["layer", "filter"],
        "properties": {
            "layer": {"type": "string"},
            "filter": {"type": "string"},
            "inputs": {"anyOf": [{"type": "string"}, {"type": "array", "items": {"type": "string"}}]},
        },
    },
}
_CHOICES: dict[str, Any] = {"kind": list(KINDS), "dtype": list(DTYPES)}
_NUMBER = {"anyOf": [{"type": "number"}, {"enum": ["inf", "-inf"]}]}
_SIMPLE: dict[Any, dict[str, Any]] = {
    float: {"$ref": "#/$defs/number"},
    int: {"type": "integer"},
    bool: {"type": "boolean"},
    str: {"type": "string"},
    Path: {"type": "string"},
    type(None): {"type": "null"},
}


def schema() -> dict[str, Any]:
    """Return the schema of what `ElevationMapConfig.load` reads."""
    root = _group(ElevationMapConfig)
    root["properties"] |= {
        "filters": root["properties"]["filters"] | _FILTERS,
        VERSION_NAME: {"const": VERSION},
        SCHEMA_NAME: {"type": "string"},
    }
    head = {"$schema": "https://json-schema.org/draft/2020-12/schema", "title": "Settings of a map of torchelev"}
    return head | root | {"$defs": {"number": _NUMBER}}


def _group(cls: Any) -> dict[str, Any]:
    meanings, hints = comments(cls), setting_types(cls)
    fields = {field.name: field for field in dataclasses.fields(cls)}
    properties = {name: _setting(hints[name], fields[name], meanings[name]) for name in fields}
    required = [name for name, field in fields.items() if _is_required(field)]
    more = {"required": required} if required else {}
    return {"type": "object", "additionalProperties": False, "properties": properties, **more}


def _is_required(field: dataclasses.Field[Any]) -> bool:
    return field.default is field.default_factory is dataclasses.MISSING


def _setting(hint: Any, field: dataclasses.Field[Any], meaning: str) -> dict[str, Any]:
    default = {"default": to_json(field.default)} if isinstance(field.default, int | float | str | tuple | None) else {}
    kind = {"enum": _CHOICES[field.name]} if field.name in _CHOICES else _type(hint)
    return {"description": re.sub(r"\bNone\b", "null", meaning), **kind, **default}


def _type(hint: Any) -> dict[str, Any]:
    if hint is Any or "FilterConfig" in str(hint) or hint == tuple[Any, ...]:
        return {}
    if isinstance(hint, types.UnionType) or typing.get_origin(hint) is typing.Union:
        return {"anyOf": [_type(option) for option in typing.get_args(hint)]}
    if typing.get_origin(hint) is Mapping:
        return {"type": "object", "additionalProperties": {"anyOf": [{"enum": list(KINDS)}, _group(ChannelConfig)]}}
    if dataclasses.is_dataclass(hint):
        return _group(hint)
    if typing.get_origin(hint) in (tuple, list):
        first, *others = typing.get_args(hint)
        sizes = {} if others[-1:] in ([], [...]) else {"minItems": 1 + len(others), "maxItems": 1 + len(others)}
        return {"type": "array", "items": _type(first), **sizes}
    return _SIMPLE[hint]


if __name__ == "__main__":
    FILE.write_text(json.dumps(schema(), indent=1) + "\n")
