"""Images of the map in C++ (`torchelev/observations/kernel`), for float32 on a CPU without gradients: as by tensors."""

from __future__ import annotations

import ctypes
from collections.abc import Iterable
from typing import TYPE_CHECKING, NamedTuple

import torch
from torch import Tensor

from torchelev.kernels.cpu_build import call, load
from torchelev.layers import Layer
from torchelev.observations.fill import MODES
from torchelev.observations.patterns import ALIGNMENTS, Pattern
from torchelev.ops.transforms import can_compute_unseen

if TYPE_CHECKING:
    from torchelev.grid import GridConfig

LIBRARY: tuple[str, dict[str, str]] = ("observations/kernel/image.cpp", {})


class Channels(NamedTuple):
    """The channels that one layer becomes."""

    layer: Layer  #: values and where they are known
    second: Layer | None  #: the layer that counts where the first is unknown
    channel: int  #: of its values; -1: none
    validity_channel: int  #: of where it is known; -1: none
    is_height: bool  #: whether values count from the ground below the base


class _Source(ctypes.Structure):
    """`Source` of image.cpp."""

    _fields_ = (
        *((name, ctypes.c_void_p) for name in ("values", "known", "second", "second_known")),
        *((name, ctypes.c_int64) for name in ("channel", "validity_channel", "is_height")),
    )


class _Images(ctypes.Structure):
    """`Images` of image.cpp."""

    _fields_ = (
        *((name, ctypes.c_void_p) for name in ("pose", "corner", "pattern", "sources", "images")),
        ("resolution", ctypes.c_double),
        *((name, ctypes.c_int64) for name in ("B", "P", "channels", "num_sources", "height", "width")),
        *((name, ctypes.c_int32) for name in ("mode", "alignment", "is_single")),
        ("nominal_height", ctypes.c_float),
    )


def can_read(T_map_base: Tensor, corner: Tensor, layers: Iterable[Tensor]) -> bool:
    """Return whether `read_images` takes the layers and poses: float32 on a CPU, and nothing to differentiate."""
    tensors = [T_map_base, corner, *layers]
    dtypes = {value.dtype for value in tensors[2:]} - {torch.bool}
    return dtypes == {torch.float32} and can_compute_unseen(tensors) and load(*LIBRARY) is not None


def read_images(
    sources: Iterable[Channels],
    pattern: Pattern,
    T_map_base: Tensor,
    corner: Tensor,
    grid: GridConfig,
    mode: str,
    nominal_height: float,
    num_channels: int,
) -> Tensor:
    """Return images (B, C, P), what `MapImage` reads by tensors."""
    library = load(*LIBRARY)
    assert library is not None
    sources = [s._replace(layer=_contiguous(s.layer), second=s.second and _contiguous(s.second)) for s in sources]
    table = (_Source * len(sources))(*(_Source(*_addresses(s.layer), *_addresses(s.second), *s[2:]) for s in sources))
    poses, corner = T_map_base.detach().double().contiguous(), corner.contiguous()
    points = pattern.on(corner.device, torch.float32)
    images = sources[0].layer[0].new_empty(len(poses), num_channels, len(points))
    settings = _Images(
        *(value.data_ptr() for value in (poses, corner, points)),
        *(ctypes.addressof(table), images.data_ptr(), grid.resolution),
        *(len(poses), len(points), num_channels, len(sources), grid.height, grid.width),
        *(MODES.index(mode), ALIGNMENTS.index(pattern.alignment), T_map_base.dtype != torch.float64, nominal_height),
    )
    call(library.read_images, ctypes.byref(settings), torch.get_num_threads())
    return images


def _contiguous(layer: Layer) -> Layer:
    return layer[0].contiguous(), layer[1].contiguous()


def _addresses(layer: Layer | None) -> tuple[int | None, int | None]:
    return (None, None) if layer is None else (layer[0].data_ptr(), layer[1].data_ptr())
