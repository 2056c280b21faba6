"""Read channels of the map, such as colours and probabilities of classes, at the points of an observation."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import torch
from torch import Tensor

from torchelev.channels.config import expand_names
from torchelev.config import ElevationMapConfig
from torchelev.errors import require
from torchelev.layers import Layer, containing_cells
from torchelev.maps.readable import ReadableMap
from torchelev.state import MapState

if TYPE_CHECKING:
    from jaxtyping import Float


def parse_channels(channels: Any, channel_fill: Any) -> tuple[str, ...]:
    """Return the names of channels as a tuple, and check what their unknown cells read."""
    is_list = isinstance(channels, list | tuple) and all(isinstance(name, str) for name in channels)
    require(is_list, "channels", "must be a list of names", repr(channels), 'give ("rgb", "terrain.stone")')
    is_number = isinstance(channel_fill, int | float) and math.isfinite(channel_fill)
    require(is_number, "channel_fill", "must be a finite number", repr(channel_fill), "leave it out for 0")
    return tuple(channels)


def count_rows(channels: Sequence[str], cfg: ElevationMapConfig) -> int:
    """Return how many components channels have in maps of a config; KeyError if one is not there."""
    hint = "give emap.cfg"
    require(
        isinstance(cfg, ElevationMapConfig), "cfg", "must be an ElevationMapConfig", type(cfg).__name__, hint, TypeError
    )
    return len(expand_names(channels, cfg.channels, "channels"))


def read_channels(
    channels: Sequence[str], fill: float, emap: ReadableMap, uv: Float[Tensor, "B M 2"], state: MapState | None
) -> Layer:
    """Read the components of channels in the cells that hold the points.

    Args:
        channels: names of channels, each of which stands for all its components, or of components.
        fill: what unknown cells read.
        emap: the maps.
        uv: the points, in cells from the window's corner.
        state: the state to read; None: that of the maps.

    Returns:
        For each component its values (B, C, M), and where they are known.

    Raises:
        KeyError: if the maps have no such channel.
    """
    names = expand_names(channels, emap.cfg.channels, "channels")
    cell, inside = containing_cells(uv, emap.cfg.grid)
    read: dict[str, Layer] = {}
    for channel in dict.fromkeys(name.split(".")[0] for name in names):
        values, known = emap.read_channel(channel, state, cell)
        components = emap.cfg.channels[channel].components(channel)
        read |= {name: (value, known & inside) for name, value in zip(components, values.unbind(-1), strict=True)}
    values, known = (torch.stack(parts, 1) for parts in zip(*(read[name] for name in names), strict=True))
    return torch.where(known, values.to(uv.dtype), fill), known
