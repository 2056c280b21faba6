"""C structs derived from Python declarations: tensors of a NamedTuple by address, settings by value."""

from __future__ import annotations

import ctypes
import re
from collections.abc import Iterable, Mapping
from typing import Any, NamedTuple

Number = bool | int | float
Settings = Mapping[str, Number | tuple[Number, ...]]

_TYPES = {"Float": "float", "Float64": "double", "Int": "int64_t", "Bool": "uint8_t", "UInt8": "uint8_t"}
SIZES = ("B", "H", "W", "S", "N", "K", "M", "P", "L")  # M = S * N; P = S if several sensors are compared, else 0
_LARGEST = 2**31 - 1  # C's settings are integers of 32 bits


class Member(NamedTuple):
    """A tensor of a NamedTuple."""

    name: str  #: of the field
    type: str  #: of its elements in C
    shape: tuple[str, ...]  #: sizes by name or number, the first of them B


def members(kind: Any) -> list[Member]:
    """Return the tensors of a NamedTuple, whose annotations are as `Float[Tensor, "B H W"] | None`."""
    found = []
    for name, annotation in kind.__annotations__.items():
        text = getattr(annotation, "__forward_arg__", str(annotation))
        match = re.match(r"(\w+)\[Tensor, ['\"]([\w ]+)['\"]\]", text)
        if match is not None:
            found.append(Member(name, _TYPES[match[1]], tuple(match[2].split())))
    return found


def tensor_struct(name: str, kind: Any, nested: Mapping[str, str] | None = None) -> str:
    """Return a C struct of pointers to a NamedTuple's tensors of B environments, with `at(b, sizes)` for one of them.

    `nested` are the structs of further fields, by field.
    """
    return _pointers(name, members(kind), nested or {})


def scratch_struct(name: str, arrays: Mapping[str, str]) -> str:
    """Return a C struct of pointers to arrays, given C type and sizes of each, as "float B M"."""
    parts = {field: text.split() for field, text in arrays.items()}
    return _pointers(name, [Member(field, kind, tuple(sizes)) for field, (kind, *sizes) in parts.items()], {})


def _pointers(name: str, tensors: list[Member], nested: Mapping[str, str]) -> str:
    fields = [f"    {m.type}* {m.name};" for m in tensors] + [f"    {t} {field};" for field, t in nested.items()]
    moves = [f"        if ({m.name}) one.{m.name} += b * {_stride(m)};" for m in tensors]
    moves += [f"        one.{field} = {field}.at(b, n);" for field in nested]
    head = f"    {name} at(int64_t b, const Sizes& n) const {{\n        {name} one = *this;"
    lines = [f"struct {name} {{", *fields, head, *moves, "        return one;", "    }", "};", ""]
    return "\n".join(lines)


def _stride(member: Member) -> str:
    sizes = [size if size.isdigit() else f"n.{size}" for size in member.shape[1:]]
    return " * ".join(sizes) or "1"


def sizes_struct(sizes: Iterable[str] = SIZES) -> str:
    """Return the C struct of the sizes that shapes are made of, by name."""
    return f"struct Sizes {{\n    int64_t {', '.join(sizes)};\n}};\n"


class Double(float):
    """A setting that C keeps in double precision."""


def _kind(value: Any) -> tuple[str, Any]:
    """Return the type of a setting in C, and in ctypes."""
    if isinstance(value, Double):
        return "double", ctypes.c_double
    return ("float", ctypes.c_float) if isinstance(value, float) else ("int32_t", ctypes.c_int32)


def settings_struct(name: str, settings: Settings) -> str:
    """Return a C struct of settings: floats as float, whole numbers and truth values as int32_t, tuples as arrays."""
    lines = []
    for field, value in settings.items():
        first, size = (value[0], f"[{len(value)}]") if isinstance(value, tuple) else (value, "")
        lines.append(f"    {_kind(first)[0]} {field}{size};")
    return "\n".join([f"struct {name} {{", *lines, "};", ""])


def c_settings(groups: Mapping[str, Settings], default: Mapping[str, Settings]) -> ctypes.Structure:
    """Return the settings of several kernels, by name, as the C struct of their structs.

    Types are those of the default settings, as in the header, whatever numbers a user gave.
    """
    parts = {name: _c_struct(settings, default[name]) for name, settings in groups.items()}
    return _structure([(name, type(part)) for name, part in parts.items()])(**parts)


def _c_struct(settings: Settings, default: Settings) -> ctypes.Structure:
    types, values = [], {}
    for field, value in settings.items():
        like = default[field]
        kind = _kind(like[0] if isinstance(like, tuple) else like)[1]
        numbers = [_converted(v, kind) for v in (value if isinstance(value, tuple) else (value,))]
        assert len(numbers) == (len(like) if isinstance(like, tuple) else 1), f"{field}: as many as by default"
        types.append((field, kind * len(numbers) if isinstance(value, tuple) else kind))
        values[field] = (kind * len(numbers))(*numbers) if isinstance(value, tuple) else numbers[0]
    return _structure(types)(**values)


def _converted(value: Number, kind: Any) -> Number:
    """Return a number as C's type takes it; whole numbers too large for it are the largest."""
    return min(int(value), _LARGEST) if kind is ctypes.c_int32 else float(value)


def _structure(fields: list[tuple[str, Any]]) -> type[ctypes.Structure]:
    return type("Settings", (ctypes.Structure,), {"_fields_": fields})
