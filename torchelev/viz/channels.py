"""The colours of channels: true ones, and one for each class."""

from __future__ import annotations

from collections.abc import Collection, Mapping
from typing import Any

import matplotlib
import numpy as np
from matplotlib.colors import to_rgb
from numpy.typing import NDArray

from torchelev.channels.config import ChannelConfig, parse_channels
from torchelev.viz.palette import COLORS

_FURTHER = "tab20"  #: colour map of the classes after the first ones


def shown_channels(config: Mapping[str, Any], layers: Collection[str]) -> dict[str, ChannelConfig]:
    """Return what `choose_channels` does, with the config of a map as a dict."""
    return choose_channels(parse_channels(config.get("channels") or {}, ()), layers)


def choose_channels(channels: Mapping[str, ChannelConfig], layers: Collection[str]) -> dict[str, ChannelConfig]:
    """Return the channels of colours and of classes whose components are among the layers, by name."""
    return {
        name: cfg
        for name, cfg in channels.items()
        if (cfg.is_color or cfg.kind.startswith("class")) and set(cfg.components(name)) <= set(layers)
    }


def class_colors(number: int) -> NDArray[np.float64]:
    """Return a colour (3,) from 0 to 1 for each of a number of classes, (number, 3); they repeat after 26."""
    further = matplotlib.colormaps[_FURTHER](np.arange(20))[:, :3]
    colors = np.concatenate([np.array([to_rgb(color) for color in COLORS]), further])
    return colors[np.arange(number) % len(colors)]


def most_probable(parts: NDArray) -> NDArray[np.float64]:
    """Return the number (H, W) of the most probable of the classes (C, H, W), NaN where none is known."""
    known = np.isfinite(parts).all(0)
    return np.where(known, np.nan_to_num(parts).argmax(0), np.nan)


def channel_colors(cfg: ChannelConfig, parts: NDArray) -> NDArray[np.float64]:
    """Return the colours (H, W, 3) of a channel from 0 to 1, NaN where unknown.

    Args:
        cfg: of colours, or of classes, whose most probable one counts.
        parts: (C, H, W) its components.
    """
    if cfg.is_color:
        return np.clip(np.moveaxis(parts, 0, -1), 0, 1)
    best = most_probable(parts)
    colors = class_colors(cfg.size)[np.nan_to_num(best).astype(np.int64)]
    return np.where(np.isfinite(best)[..., None], colors, np.nan)


def class_legend(cfg: ChannelConfig, parts: NDArray) -> dict[str, NDArray[np.float64]]:
    """Return the names, or numbers, of the classes that are the most probable somewhere, with their colours (3,)."""
    names, colors = cfg.names or tuple(map(str, range(cfg.size))), class_colors(cfg.size)
    best = most_probable(parts)
    return {names[int(k)]: colors[int(k)] for k in np.unique(best[np.isfinite(best)])}
