"""Channels in C++ (`channels.cpp`), for updates of float32 on a CPU: the same values as by tensors."""

from __future__ import annotations

import ctypes
import math
from collections.abc import Mapping
from typing import TYPE_CHECKING

import torch
from torch import Tensor

from torchelev.channels.config import KINDS, ChannelConfig
from torchelev.channels.state import Channel, Ground
from torchelev.grid import GridConfig
from torchelev.kernels.cpu_build import call, load
from torchelev.ops.transforms import can_compute_unseen
from torchelev.stages.measure.config import BodyConfig
from torchelev.state import MapState

if TYPE_CHECKING:
    from jaxtyping import Bool, Float

    from torchelev.inputs.update_inputs import Inputs
    from torchelev.stages.measure.config import SensorConfig

LIBRARY: tuple[str, dict[str, str]] = ("channels/kernel/channels.cpp", {})


class _Channel(ctypes.Structure):
    """`Channel` of channels.cpp."""

    _fields_ = (
        *((name, ctypes.c_void_p) for name in ("values", "weight", "age", "features")),
        ("C", ctypes.c_int64),
        ("kind", ctypes.c_int32),
        *((name, ctypes.c_float) for name in ("rate", "half_life", "max_age", "tolerance")),
    )


_MAPS = (
    *("points", "T_map_sensor", "T_map_base", "variance", "own", "dt", "drift"),
    *("corner_now", "elevation", "validity", "corner", "height"),
)


class _Update(ctypes.Structure):
    """`Update` of channels.cpp."""

    _fields_ = (
        *((name, ctypes.c_void_p) for name in (*_MAPS, "channels")),
        *((name, ctypes.c_int64) for name in "BSNHWK"),
        ("resolution", ctypes.c_double),
        *((name, ctypes.c_float) for name in ("noise_factor", "noise_floor", "min_distance", "max_distance")),
        ("box", ctypes.c_float * 6),
        ("ramp", ctypes.c_float * 4),
        ("has_box", ctypes.c_int32),
        ("has_ramp", ctypes.c_int32),
    )


def can_update(channels: Mapping[str, Channel], state: MapState, sensor: SensorConfig) -> bool:
    """Return whether `update_in_cpp` takes these: float32 on a CPU, with nothing to differentiate or to trace."""
    if sensor.depth is not None:
        return False
    tensors = (state.elevation, *(channel.values for channel in channels.values()))
    is_plain = all(value.dtype == torch.float32 and value.is_contiguous() for value in tensors)
    return is_plain and can_compute_unseen(tensors) and load(*LIBRARY) is not None


def update_in_cpp(
    channels: Mapping[str, Channel],
    configs: Mapping[str, ChannelConfig],
    ground: Ground,
    state: MapState,
    grid: GridConfig,
    sensor: SensorConfig,
    dt: Float[Tensor, "B"] | None,
    inputs: Inputs | None,
    own: Bool[Tensor, "B S N"] | None,
    features: Mapping[str, Float[Tensor, "B M C"]],
) -> None:
    """Follow the maps, and fuse what points bring, in place; arguments as of `Channels.update`."""
    library = load(*LIBRARY)
    assert library is not None, "asked without `can_update`"
    B = len(ground.corner)
    drift = None if dt is None else state.statistics.drift_correction
    given = {name: x.contiguous() for name, x in features.items()} if inputs is not None else {}
    cloud: list[Tensor | None] = [None] * 5
    S = N = 0
    if inputs is not None and given:
        S, N = inputs.points.shape[1:3]
        variance = None if inputs.variance is None else inputs.variance.float()
        base = None if inputs.T_map_base is None else inputs.T_map_base.double()
        cloud = [inputs.points.float(), inputs.T_map_sensor.double(), base, variance, own]
    times = [torch.zeros(B) if dt is None else dt.float(), drift]
    maps = [state.corner, state.elevation, state.validity]
    read = [None if value is None else value.contiguous() for value in (*cloud, *times, *maps)]
    structs = (_Channel * len(channels))(
        *(_struct(channel, configs[name], given.get(name)) for name, channel in channels.items())
    )
    addresses = (None if value is None else value.data_ptr() for value in (*read, *ground))
    sizes = (B, S, N, grid.height, grid.width, len(channels))
    limits = (sensor.noise_factor, sensor.noise_floor, sensor.min_distance, sensor.max_distance)
    box = sensor.body if isinstance(sensor.body, BodyConfig) else None
    corners = (ctypes.c_float * 6)(*(() if box is None else (*box.lower, *box.upper)))
    ramp = sensor.exclusion
    slope = (ctypes.c_float * 4)(*(() if ramp is None else (ramp.slope, ramp.distance, ramp.offset, ramp.height)))
    numbers = (*sizes, grid.resolution, *limits, corners, slope, int(box is not None), int(ramp is not None))
    update = _Update(*addresses, ctypes.addressof(structs), *numbers)
    call(library.update_channels, ctypes.byref(update), torch.get_num_threads())


def _struct(channel: Channel, cfg: ChannelConfig, features: Tensor | None) -> _Channel:
    addresses = (None if value is None else value.data_ptr() for value in (*channel, features))
    ages = (math.inf if age is None else age for age in (cfg.half_life, cfg.max_age))
    return _Channel(*addresses, cfg.size, KINDS.index(cfg.kind), cfg.rate, *ages, cfg.tolerance)
