"""Messages and services for rclpy, made at run time of those that are installed: without compiler and headers.

A message is a row of parts, each of an installed type. A float64 is a std_msgs/Float64, a string[] the request of
rcl_interfaces/DescribeParameters: on the wire a message is its fields, one after the other. So each function that ROS
asks of a type calls the same function of its parts. There are two sets of them: introspection, for Cyclone DDS, and
fastrtps, for Fast DDS.

Left out: hashes and descriptions of types, which Jazzy only shows, and the events of services. As Python runs while
the middleware holds a reader's lock, two Python threads of a process must not both use one topic of these types: they
wait for each other for ever.
"""

from __future__ import annotations

import ctypes
from collections.abc import Iterator
from ctypes import addressof, c_bool, c_size_t, c_uint32, c_void_p, sizeof
from functools import cache, partial
from typing import Any

from rcl_interfaces.srv import DescribeParameters
from rclpy.type_support import check_for_type_support
from std_msgs.msg import Float64, String, UInt16, UInt32

from grid_map_msgs import abi

INTROSPECTION, FASTRTPS = b"rosidl_typesupport_introspection_c", b"rosidl_typesupport_fastrtps_c"
IS_MESSAGE = 18  # a member's type
_alive: list[Any] = []  # what C points to


def _keep(made: Any) -> Any:
    _alive.append(made)
    return made


@cache
class Support:
    """What ROS's libraries know of a type, installed or made here."""

    def __init__(self, kind: type):
        check_for_type_support(kind)
        meta: Any = type(kind)
        self.handle = abi.Handle.from_address(abi.pointer_of(meta._TYPE_SUPPORT))
        self.introspection, self.fastrtps = (
            abi.Handle.from_address(self.handle.find(addressof(self.handle), name))
            for name in (INTROSPECTION, FASTRTPS)
        )
        self.members = abi.Members.from_address(self.introspection.data)
        self.callbacks = abi.Callbacks.from_address(self.fastrtps.data)
        self.from_python = abi.FROM_PYTHON(abi.pointer_of(meta._CONVERT_FROM_PY))
        self.to_python = abi.TO_PYTHON(abi.pointer_of(meta._CONVERT_TO_PY))
        self.path = f"{self.members.space.decode()}__{self.members.name.decode()}"
        self.measure = getattr(meta, "_MEASURE", None) or self.load(
            "typesupport_fastrtps_c", f"get_serialized_size_{self.path}", c_size_t, c_void_p, c_size_t
        )

    def load(self, library: str, name: str, result: Any, *arguments: Any) -> Any:
        """Return a function of the type's package."""
        function = ctypes.PyDLL(f"lib{self.path.partition('__')[0]}__rosidl_{library}.so")[name]
        function.restype, function.argtypes = result, arguments
        return function


class One:
    """A part of a message.

    Args:
        kind: its type.
        field: the only one of its type, which stands for it; "" for all of it.
    """

    def __init__(self, kind: Any, field: str = ""):
        self.kind, self.field, self.support = kind, field, Support(kind)
        members, callbacks = self.support.members, self.support.callbacks
        self.size, self.init, self.fini = members.size, members.init, members.fini
        self.from_python, self.to_python = self.support.from_python, self.support.to_python
        self.serialize, self.deserialize = callbacks.serialize, callbacks.deserialize
        self.measure = self.support.measure

    def new(self) -> Any:
        part = self.kind()
        if hasattr(part, "_check_fields"):  # Jazzy checks only on demand
            part._check_fields = True
        return part

    def get(self, part: Any) -> Any:
        return getattr(part, self.field) if self.field else part

    def set(self, part: Any, value: Any) -> Any:
        """Return the part with another value."""
        if not self.field:
            assert isinstance(value, self.kind), f"must be a {self.kind.__name__}, got {value!r}"
            return value
        setattr(part, self.field, value)
        return part

    def member(self) -> Any:
        """Return the part's entry for introspection, without name and offset."""
        if self.field:
            return abi.Member.from_buffer_copy(self.support.members.members[0])
        return abi.Member(type=IS_MESSAGE, handle=addressof(self.support.introspection))


class Many:
    """A part that is a sequence of messages of an installed type. It has the functions of One."""

    def __init__(self, kind: Any):
        self.one, self.length, self.size, self.new = One(kind), Support(UInt32).callbacks, sizeof(abi.Sequence), list
        load, name = self.one.support.load, f"{self.one.support.path}__Sequence__"
        self._init = load("generator_c", f"{name}init", c_bool, c_void_p, c_size_t)
        self.fini = load("generator_c", f"{name}fini", None, c_void_p)

    def get(self, parts: list[Any]) -> list[Any]:
        return parts

    def set(self, _: list[Any], values: list[Any]) -> list[Any]:
        kind = self.one.kind
        assert isinstance(values, (list, tuple)), f"must be a list, got {values!r}"
        assert all(isinstance(value, kind) for value in values), f"must be of {kind.__name__}, got {values!r}"
        return values

    def member(self) -> Any:
        entry, get = self.one.member(), abi.GET(self._item)
        entry.is_array, entry.size, entry.get, entry.get_const = True, abi.SIZE(self._count), get, get
        entry.resize = abi.RESIZE(self._resize)
        return entry

    def init(self, address: int, _: int) -> None:
        self._init(address, 0)

    def from_python(self, parts: list[Any], address: int) -> bool:
        self._resize(address, len(parts))
        return all(self.one.from_python(part, item) for part, item in zip(parts, self._items(address), strict=True))

    def to_python(self, address: int) -> list[Any]:
        return [self.one.to_python(item) for item in self._items(address)]

    def serialize(self, address: int, cdr: int) -> bool:
        count = c_uint32(self._count(address))
        done = self.length.serialize(addressof(count), cdr)
        return done and all(self.one.serialize(item, cdr) for item in self._items(address))

    def deserialize(self, cdr: int, address: int) -> bool:
        count = c_uint32()
        done = self.length.deserialize(cdr, addressof(count)) and self._resize(address, count.value)
        return done and all(self.one.deserialize(cdr, item) for item in self._items(address))

    def measure(self, address: int, begin: int) -> int:
        end = -(-begin // 4) * 4 + 4
        for item in self._items(address):
            end += self.one.measure(item, end)
        return end - begin

    def _count(self, address: int) -> int:
        return abi.Sequence.from_address(address).size

    def _item(self, address: int, index: int) -> int:
        return abi.Sequence.from_address(address).data + index * self.one.size

    def _items(self, address: int) -> Iterator[int]:
        return (self._item(address, k) for k in range(self._count(address)))

    def _resize(self, address: int, count: int) -> bool:
        self.fini(address)
        return self._init(address, count)


FLOAT64, UINT16, STRING = One(Float64, "data"), One(UInt16, "data"), One(String, "data")
STRINGS = One(DescribeParameters.Request, "names")


class Message:
    """A message; its values are checked as those of rclpy's messages are."""

    __slots__ = ("_values",)
    _parts: dict[str, Any]

    def __init__(self, **values: Any):
        self._values = {name: part.new() for name, part in self._parts.items()}
        for name, value in values.items():
            setattr(self, name, value)

    def __eq__(self, other: object) -> bool:
        return isinstance(other, type(self)) and self._values == other._values

    def __repr__(self) -> str:
        return f"{type(self).__name__}({', '.join(f'{name}={getattr(self, name)!r}' for name in self._parts)})"


def _property(name: str, part: Any) -> property:
    def change(self: Message, value: Any) -> None:
        self._values[name] = part.set(self._values[name], value)

    return property(lambda self: part.get(self._values[name]), change)


class Row:
    """The functions of a message's type: its parts lie in a struct one after the other."""

    def __init__(self, parts: dict[str, Any]):
        self.parts, self.offsets, self.size = parts, {}, 0
        for name, part in parts.items():
            self.offsets[name] = self.size
            self.size += -(-part.size // 8) * 8
        self.structs: dict[int, Any] = {}
        self.kind: Any = None

    def _at(self, address: int) -> Iterator[tuple[str, Any, int]]:
        return ((name, part, address + self.offsets[name]) for name, part in self.parts.items())

    def create(self) -> int:
        struct = ctypes.create_string_buffer(self.size)
        self.structs[addressof(struct)] = struct
        self.init(addressof(struct), 0)
        return addressof(struct)

    def destroy(self, address: int) -> None:
        self.fini(address)
        del self.structs[address]

    def init(self, address: int, how: int) -> None:
        for _, part, where in self._at(address):
            part.init(where, how)

    def fini(self, address: int) -> None:
        for _, part, where in self._at(address):
            part.fini(where)

    def from_python(self, message: Message, address: int) -> bool:
        return all(part.from_python(message._values[name], where) for name, part, where in self._at(address))

    def to_python(self, address: int) -> Message:
        message = self.kind()
        message._values.update({name: part.to_python(where) for name, part, where in self._at(address)})
        return message

    def serialize(self, address: int, cdr: int) -> bool:
        return all(part.serialize(where, cdr) for _, part, where in self._at(address))

    def deserialize(self, cdr: int, address: int) -> bool:
        return all(part.deserialize(cdr, where) for _, part, where in self._at(address))

    def measure(self, address: int, begin: int = 0) -> int:
        end = begin
        for _, part, where in self._at(address):
            end += part.measure(where, end)
        return end - begin

    def max_size(self, bounds: int) -> int:
        ctypes.c_char.from_address(bounds).value = b"\0"  # there is none
        return 0

    def introspection(self, space: str, name: str) -> Any:
        """Return the table of introspection."""
        entries = (abi.Member * len(self.parts))()
        for k, (field, part) in enumerate(self.parts.items()):
            entries[k] = _keep(part.member())
            entries[k].name, entries[k].offset = field.encode(), self.offsets[field]
        names = {"space": space.replace("/", "__").encode(), "name": name.encode()}
        functions = {"init": abi.INIT(self.init), "fini": abi.DESTROY(self.fini)}
        return _keep(abi.Members(**names, count=len(entries), size=self.size, members=entries, **functions))

    def fastrtps(self, space: str, name: str) -> Any:
        """Return the table of fastrtps."""
        functions = abi.CODE(self.serialize), abi.CODE(self.deserialize)
        sizes = abi.MEASURE(self.measure), abi.MAX_SIZE(self.max_size)
        return _keep(abi.Callbacks(space.replace("/", "::").encode(), name.encode(), *functions, *sizes))


def _no_description(path: str) -> dict[str, Any]:
    """Return functions that give a hash that is not set, a name without fields, and no sources."""
    text = ctypes.create_string_buffer(path.encode())
    description = (c_void_p * 9)(addressof(text), len(path), len(path) + 1)
    tables = {"hash": (ctypes.c_ubyte * 33)(), "description": description, "sources": (c_void_p * 3)()}
    _keep((text, tables))
    return {name: abi.DESCRIBE(partial(lambda where, _: where, addressof(table))) for name, table in tables.items()}


def _handle(kind: Any, path: str, introspection: Any, fastrtps: Any, **types: int) -> Any:
    """Return a handle by which ROS finds those of introspection and fastrtps."""
    like, found = Support(Float64), {}
    more = {"find": _keep(abi.FIND(lambda _, name: found.get(name))), **types, **_no_description(path)}
    for name, of, table in (INTROSPECTION, like.introspection, introspection), (FASTRTPS, like.fastrtps, fastrtps):
        found[name] = addressof(_keep(kind(identifier=of.identifier, data=addressof(table), **more)))
    return _keep(kind(identifier=like.handle.identifier, **more))


def _metaclass(name: str, **capsules: Any) -> Any:
    """Return where rclpy looks for the functions of a class."""
    return type(f"Metaclass_{name}", (type,), {key: abi.to_capsule(_keep(made)) for key, made in capsules.items()})


def make_message(path: str, /, **parts: One | Many) -> Any:
    """Return the class of a message, such as "grid_map_msgs/msg/GridMap"."""
    space, _, name = path.rpartition("/")
    row = Row(parts)
    meta = _metaclass(
        name,
        _CREATE_ROS_MESSAGE=abi.CREATE(row.create),
        _DESTROY_ROS_MESSAGE=abi.DESTROY(row.destroy),
        _CONVERT_FROM_PY=abi.FROM_PYTHON(row.from_python),
        _CONVERT_TO_PY=abi.TO_PYTHON(row.to_python),
        _TYPE_SUPPORT=_handle(abi.Handle, path, row.introspection(space, name), row.fastrtps(space, name)),
    )
    meta._MEASURE = row.measure
    own = {"__slots__": (), "__module__": space.replace("/", "."), "_parts": parts}
    row.kind = meta(name, (Message,), own | {field: _property(field, part) for field, part in parts.items()})
    return row.kind


def make_service(path: str, request: Any, response: Any) -> Any:
    """Return the class of a service, such as "grid_map_msgs/srv/GetGridMap"."""
    space, _, name = path.rpartition("/")
    a, b = Support(request), Support(response)
    kinds, tables = {"request": addressof(a.handle), "response": addressof(b.handle)}, []
    for text, ab in ("__", (a.members, b.members)), ("::", (a.fastrtps, b.fastrtps)):
        tables.append(_keep(abi.Service(space.replace("/", text).encode(), name.encode(), *map(addressof, ab))))
    meta = _metaclass(name, _TYPE_SUPPORT=_handle(abi.ServiceHandle, path, *tables, **kinds))
    return meta(name, (), {"__module__": space.replace("/", "."), "Request": request, "Response": response})
