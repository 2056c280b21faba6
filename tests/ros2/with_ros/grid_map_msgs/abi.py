"""What ROS declares in C for the types of messages and services, in Humble and in Jazzy."""

import ctypes
import os
from ctypes import POINTER, PYFUNCTYPE, Structure, c_bool, c_char_p, c_size_t, c_uint32, c_void_p, py_object
from typing import Any

IS_HUMBLE = os.environ["ROS_DISTRO"] == "humble"

CREATE, DESTROY, RESIZE = PYFUNCTYPE(c_void_p), PYFUNCTYPE(None, c_void_p), PYFUNCTYPE(c_bool, c_void_p, c_size_t)
FROM_PYTHON, TO_PYTHON = PYFUNCTYPE(c_bool, py_object, c_void_p), PYFUNCTYPE(py_object, c_void_p)
INIT, SIZE = PYFUNCTYPE(None, c_void_p, ctypes.c_int), PYFUNCTYPE(c_size_t, c_void_p)
GET, MAX_SIZE = PYFUNCTYPE(c_void_p, c_void_p, c_size_t), PYFUNCTYPE(c_size_t, c_void_p)
CODE, MEASURE = PYFUNCTYPE(c_bool, c_void_p, c_void_p), PYFUNCTYPE(c_uint32, c_void_p)
FIND, DESCRIBE = PYFUNCTYPE(c_void_p, c_void_p, c_char_p), PYFUNCTYPE(c_void_p, c_void_p)


def _struct(name: str, /, **fields: Any) -> Any:
    return type(name, (Structure,), {"_fields_": list(fields.items())})


_names: Any = {"space": c_char_p, "name": c_char_p}
_handle: Any = {"identifier": c_void_p, "data": c_void_p, "find": FIND}
_describe: Any = {"hash": DESCRIBE, "description": DESCRIBE, "sources": DESCRIBE}  # not in Humble
_events: Any = {"event": c_void_p, "create_event": c_void_p, "destroy_event": c_void_p}

# rosidl_message_type_support_t, rosidl_service_type_support_t; the data of a service's handle
Handle = _struct("Handle", **_handle, **_describe)
ServiceHandle = _struct("ServiceHandle", **_handle, request=c_void_p, response=c_void_p, **_events, **_describe)
Service = _struct("Service", **_names, request=c_void_p, response=c_void_p, event=c_void_p)

# rosidl_typesupport_introspection_c__MessageMember, and all of a message
Member = _struct(
    "Member",
    name=c_char_p,
    type=ctypes.c_uint8,
    length=c_size_t,
    handle=c_void_p,
    **({} if IS_HUMBLE else {"is_key": c_bool}),
    is_array=c_bool,
    array_size=c_size_t,
    is_bound=c_bool,
    offset=c_uint32,
    default=c_void_p,
    size=SIZE,
    get_const=GET,
    get=GET,
    fetch=c_void_p,
    assign=c_void_p,
    resize=RESIZE,
)
Members = _struct(
    "Members",
    **_names,
    count=c_uint32,
    size=c_size_t,
    **({} if IS_HUMBLE else {"has_key": c_bool}),
    members=POINTER(Member),
    init=INIT,
    fini=DESTROY,
)

# message_type_support_callbacks_t of fastrtps; Humble lacks the last
Callbacks = _struct(
    "Callbacks", **_names, serialize=CODE, deserialize=CODE, measure=MEASURE, max_size=MAX_SIZE, keys=c_void_p
)
Sequence = _struct("Sequence", data=c_void_p, size=c_size_t, capacity=c_size_t)

_api = ctypes.pythonapi
_api.PyCapsule_New.restype, _api.PyCapsule_New.argtypes = py_object, (c_void_p, c_char_p, c_void_p)
_api.PyCapsule_GetPointer.restype, _api.PyCapsule_GetPointer.argtypes = c_void_p, (py_object, c_char_p)


def to_capsule(made: Any) -> Any:
    """Return the capsule of a function or structure, which must stay alive."""
    is_struct = isinstance(made, Structure)
    return _api.PyCapsule_New(ctypes.addressof(made) if is_struct else ctypes.cast(made, c_void_p), None, None)


def pointer_of(capsule: Any) -> int:
    """Return where a capsule points."""
    return _api.PyCapsule_GetPointer(capsule, None)
