"""A map as a picture with axes: what `ElevationMap.save_png` and `torchelev map` draw."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from torchelev.errors import require
from torchelev.io.export import SavedMap, take
from torchelev.viz.channels import channel_colors, class_legend, shown_channels
from torchelev.viz.palette import DEVIATIONS, RATINGS
from torchelev.viz.plot import Panel, save_layers

if TYPE_CHECKING:
    from torchelev.elevation_map import ElevationMap


def save_map_picture(path: str | Path, emap: ElevationMap, layers: Sequence[str] | None = None, env: int = 0) -> None:
    """Draw layers of one environment; see `ElevationMap.save_png`."""
    is_png = Path(path).suffix.lower() == ".png"
    require(
        is_png, "path", "must end in .png", str(path), "name it map.png; torchelev.viz.plot.draw_layers makes figures"
    )
    if layers is None:
        saved = take(emap, env)
        panels = choose_panels(saved, tuple(step.layer for step in emap.cfg.filters))
    else:
        hint = 'give a list, such as ["elevation"]; of a channel its components, such as "rgb.red"'
        is_list = not isinstance(layers, str) and len(layers) > 0 and all(name in emap.layers for name in layers)
        require(is_list, "layers", f"must be names among {', '.join(emap.layers)}", repr(layers), hint)
        saved = take(emap, env, layers)
        panels = [Panel(title=name, values=saved.layers[name]) for name in layers]
    save_layers(path, panels, extent=saved.extent)


def choose_panels(saved: SavedMap, filters: Sequence[str] = ()) -> list[Panel]:
    """Return panels of the main layers, colours and classes, and filters; heights share one colour scale."""
    layers = saved.layers
    elevation, traversability = layers["elevation"], layers["traversability"]
    known = elevation[np.isfinite(elevation)]
    low, high = (float(v) for v in np.percentile(known, [1, 99])) if known.size else (None, None)
    return [
        Panel(title="elevation", values=elevation, unit="m", vmin=low, vmax=high),
        Panel(title="standard deviation", values=np.sqrt(layers["variance"]), unit="m", cmap=DEVIATIONS, vmin=0.0),
        Panel(title="traversability", values=traversability, unit="0 to 1", cmap=RATINGS, vmin=0.0, vmax=1.0),
        Panel(title="upper bound", values=layers["upper_bound"], unit="m", vmin=low, vmax=high),
        *_clearance_panel(saved),
        *_channel_panels(saved),
        *(Panel(title=name, values=layers[name]) for name in filters),
    ]


def _clearance_panel(saved: SavedMap) -> Iterator[Panel]:
    """Yield a panel of the clearance, of a map with levels."""
    if "clearance" in saved.layers:
        values = np.where(np.isinf(saved.layers["clearance"]), np.nan, saved.layers["clearance"])
        yield Panel(title="clearance below ceilings", values=values, unit="m")


def _channel_panels(saved: SavedMap) -> Iterator[Panel]:
    """Yield a panel of true colours for each channel of colours, and of the most probable class for each of classes."""
    for name, cfg in shown_channels(saved.config, saved.layers).items():
        parts = np.stack([saved.layers[part] for part in cfg.components(name)])
        colors, is_color = channel_colors(cfg, parts), cfg.is_color
        legend = {} if is_color else class_legend(cfg, parts)
        yield Panel(title=name if is_color else f"most probable {name}", values=colors, legend=legend)
