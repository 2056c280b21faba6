"""The colours of layers and channels: colour maps, their limits, and a legend."""

from __future__ import annotations

from html import escape
from typing import NamedTuple

import matplotlib
import numpy as np
from numpy.typing import NDArray

from torchelev.channels.config import ChannelConfig
from torchelev.viz.channels import channel_colors, class_legend
from torchelev.viz.palette import DEVIATIONS, HEIGHTS, RATINGS

DEVIATION = "standard deviation"  #: shown in place of the variance
_UNITS = {"elevation": "m", "upper_bound": "m", DEVIATION: "m", "time": "s", "ceiling": "m", "clearance": "m"}
_COLOR_MAPS = {DEVIATION: DEVIATIONS, "traversability": RATINGS, "time": "cividis_r"}
_FIXED_LIMITS = {"traversability": (0.0, 1.0), "validity": (0.0, 1.0), "normal_z": (0.0, 1.0)}
_SETTLED = 0.1  # share of their span by which limits may be off before they move, so that colours do not flicker
_UNKNOWN = (217, 217, 217, 255)
_BOX = "padding: 0.3em 0.8em; font-size: 0.85em"  # style of a legend


class Limits(NamedTuple):
    """The range of values that the colours span."""

    low: float  #: value of the lowest colour, in the layer's unit
    high: float  #: value of the highest colour


def choose_limits(layer: str, values: NDArray, before: Limits | None = None) -> Limits:
    """Return a layer's limits: fixed ones of ratings, else the 1st to the 99th percentile of the known values.

    Args:
        layer: its name.
        values: any shape, NaN where unknown.
        before: the limits of the picture before, kept while they are about right.
    """
    if layer in _FIXED_LIMITS:
        return Limits(*_FIXED_LIMITS[layer])
    known = values[np.isfinite(values)]
    low, high = (float(v) for v in np.percentile(known, [1, 99])) if known.size else (0.0, 1.0)
    low = 0.0 if layer in (DEVIATION, "time") else low
    high = max(high, low + 1e-3)
    if before is not None:
        allowed = _SETTLED * (before.high - before.low)
        if abs(low - before.low) < allowed and abs(high - before.high) < allowed:
            return before
    return Limits(low, high)


def colorize(layer: str, values: NDArray, limits: Limits) -> NDArray[np.uint8]:
    """Return the colours (..., 4) of values, sRGB; unknown ones are grey."""
    table = matplotlib.colormaps[_COLOR_MAPS.get(layer, HEIGHTS)](np.linspace(0, 1, 256), bytes=True)
    share = (values - limits.low) / (limits.high - limits.low)
    index = (np.clip(np.nan_to_num(share), 0, 1) * 255).astype(np.uint8)
    return np.where(np.isfinite(values)[..., None], table[index], np.array(_UNKNOWN, np.uint8))


def colorize_channel(cfg: ChannelConfig, parts: NDArray) -> NDArray[np.uint8]:
    """Return the colours (H, W, 4) of a channel of colours or classes with components (C, H, W), grey where unknown."""
    colors = channel_colors(cfg, parts)
    opaque = np.concatenate([np.rint(255 * np.nan_to_num(colors)), np.full((*colors.shape[:2], 1), 255.0)], -1)
    is_known = np.isfinite(colors).all(-1, keepdims=True)
    return np.where(is_known, opaque.astype(np.uint8), np.array(_UNKNOWN, np.uint8))


def channel_legend(name: str, cfg: ChannelConfig, parts: NDArray) -> str:
    """Return the name of a channel, and of classes those that are the most probable somewhere, as HTML."""
    if cfg.is_color:
        return f'<div style="{_BOX}">{escape(name)}, as seen</div>'
    classes = class_legend(cfg, parts)
    rows = "".join(
        f'<div><span style="display: inline-block; width: 0.9em; height: 0.9em; border-radius: 3px; '
        f'background: rgb({r}, {g}, {b})"></span> {escape(label)}</div>'
        for label, (r, g, b) in ((label, np.rint(255 * rgb).astype(int)) for label, rgb in classes.items())
    )
    return f'<div style="{_BOX}"><div>{escape(name)}, most probable class</div>{rows}</div>'


def legend(layer: str, limits: Limits) -> str:
    """Return a colour bar with its numbers as HTML."""
    stops = colorize(layer, np.linspace(0, 1, 9), Limits(0, 1))
    gradient = ", ".join(f"rgb({r}, {g}, {b})" for r, g, b, _ in stops)
    numbers = "".join(f"<span>{_format(v)}</span>" for v in np.linspace(limits.low, limits.high, 3))
    unit = f" [{_UNITS[layer]}]" if layer in _UNITS else ""
    return (
        f'<div style="{_BOX}"><div>{layer}{unit}</div>'
        f'<div style="height: 0.9em; border-radius: 3px; background: linear-gradient(90deg, {gradient})"></div>'
        f'<div style="display: flex; justify-content: space-between">{numbers}</div></div>'
    )


def describe(layer: str, value: float) -> str:
    """Return a value with its unit."""
    return f"{_format(value)} {_UNITS.get(layer, '')}".strip() if np.isfinite(value) else "unknown"


def _format(value: float) -> str:
    return f"{value:.3f}" if abs(value) < 1 else f"{value:.2f}"


def shown_layers(layers: dict[str, NDArray]) -> dict[str, NDArray]:
    """Return the layers as the page shows them: the variance as a standard deviation."""
    return {DEVIATION if k == "variance" else k: np.sqrt(v) if k == "variance" else v for k, v in layers.items()}
