"""Which cells cameras see, in C++ (`views.cpp`), for float32 on a CPU: the same as by tensors (`camera.py`)."""

from __future__ import annotations

import ctypes
from typing import TYPE_CHECKING

import torch
from torch import Tensor

from torchelev.channels.camera import View, largest_radius
from torchelev.channels.config import KINDS, ChannelConfig
from torchelev.channels.native import LIBRARY as UPDATES
from torchelev.channels.state import Channel
from torchelev.grid import GridConfig
from torchelev.kernels.cpu_build import call, load
from torchelev.ops.transforms import is_readable
from torchelev.state import MapState

if TYPE_CHECKING:
    from jaxtyping import Float

LIBRARY: tuple[str, dict[str, str]] = ("channels/kernel/views.cpp", {})


class _Views(ctypes.Structure):
    """`Views` of views.cpp."""

    _fields_ = (
        *((name, ctypes.c_void_p) for name in ("cameras", "elevation", "validity", "uv", "seen")),
        *((name, ctypes.c_int64) for name in ("B", "V", "H", "W", "image_height", "image_width")),
        *((name, ctypes.c_float) for name in ("resolution", "margin")),
    )


class _Painting(ctypes.Structure):
    """`Painting` of views.cpp."""

    _fields_ = (
        *((name, ctypes.c_void_p) for name in ("image", "uv", "seen", "values", "weight", "age")),
        *((name, ctypes.c_int64) for name in ("B", "V", "C", "cells", "image_height", "image_width")),
        *((name, ctypes.c_int32) for name in ("kind", "is_nearest")),
        ("rate", ctypes.c_float),
    )


def build_libraries() -> None:
    """Build what updates and paintings of channels run on, if there is a compiler."""
    for library in (LIBRARY, UPDATES):
        load(*library)


def can_paint(channel: Channel) -> bool:
    """Return whether `paint_in_cpp` takes the channel."""
    is_plain = channel.values.dtype == torch.float32 and channel.values.is_contiguous()
    return is_plain and is_readable(channel.values) and load(*LIBRARY) is not None


def paint_in_cpp(
    channel: Channel, image: Float[Tensor, "B V C h w"], view: View, mode: str, cfg: ChannelConfig
) -> None:
    """Do what `paint.sample` and `paint.fuse_view` do, in place."""
    library = load(*LIBRARY)
    assert library is not None, "asked without `can_paint`"
    B, V, C, h, w = image.shape
    read = [image.contiguous(), view.uv.contiguous(), view.seen.contiguous(), *channel]
    addresses = (None if value is None else value.data_ptr() for value in read)
    cells = view.seen.shape[-2] * view.seen.shape[-1]
    choices = (KINDS.index(cfg.kind), mode == "nearest", cfg.rate)
    call(
        library.paint_channel,
        ctypes.byref(_Painting(*addresses, B, V, C, cells, h, w, *choices)),
        torch.get_num_threads(),
    )


def can_look(state: MapState) -> bool:
    """Return whether `look_in_cpp` takes the maps."""
    return state.elevation.dtype == torch.float32 and is_readable(state.elevation) and load(*LIBRARY) is not None


def look_in_cpp(
    state: MapState,
    grid: GridConfig,
    K: Float[Tensor, "B V 3 3"],
    T_map_camera: Float[Tensor, "B V 4 4"],
    size: tuple[int, int],
    distortion: Float[Tensor, "B V D"] | None,
    margin: float,
) -> View:
    """Project cells into pictures, and find those that the map does not hide; arguments as of `camera`."""
    library = load(*LIBRARY)
    assert library is not None, "asked without `can_look`"
    B, V = T_map_camera.shape[:2]
    cameras = _pack(state, grid, K, T_map_camera, distortion)
    uv = torch.empty(B, V, grid.height, grid.width, 2)
    seen = torch.empty(B, V, grid.height, grid.width, dtype=torch.bool)
    read = [cameras, state.elevation.contiguous(), state.validity.contiguous(), uv, seen]
    addresses = (value.data_ptr() for value in read)
    views = _Views(*addresses, B, V, grid.height, grid.width, *size, grid.resolution, margin)
    call(library.find_seen, ctypes.byref(views), torch.get_num_threads())
    return View(uv, seen)


def _pack(
    state: MapState, grid: GridConfig, K: Tensor, T: Tensor, distortion: Tensor | None
) -> Float[Tensor, "B V 26"]:
    """Return the cameras as `Camera` of camera.h."""
    first = (state.corner.double() + 0.5) * grid.resolution
    place = torch.cat([first[:, None] - T[..., :2, 3].double(), T[..., 2, 3, None].double()], -1)
    intrinsics = K[..., (0, 0, 0, 1, 1), (0, 1, 2, 1, 2)]
    lens, radius = K.new_zeros(*K.shape[:2], 8), K.new_full((*K.shape[:2], 1), torch.inf)
    if distortion is not None:
        lens[..., : distortion.shape[-1]] = distortion
        radius = largest_radius(distortion)[..., None]
    parts = (T[..., :3, :3].flatten(2), place, intrinsics, lens, radius)
    return torch.cat([part.float() for part in parts], -1).contiguous()
