"""The command line's settings: a YAML by stage, with resolution and size over it."""

from __future__ import annotations

import math
import re
from pathlib import Path

from torchelev.config import ElevationMapConfig

RESOLUTION, SIZE = 0.1, 20.0  # [m]
MAX_CELLS = 16_000_000  # an update takes about 350 bytes of memory per cell


def load_config(path: Path | None, resolution: float | None, size: float | None) -> ElevationMapConfig:
    """Settings of the YAML at `path`, with the command line's resolution and size [m] over them."""
    values = {} if path is None else _read_yaml(path)
    grid = values.get("grid") or {}
    if not isinstance(grid, dict):
        raise ValueError(f"{path}: config.grid must be a mapping; see ElevationMapConfig")
    try:
        return ElevationMapConfig.from_dict({**values, "grid": _grid(grid, resolution, size)})
    except (ValueError, TypeError) as error:
        raise ValueError(f"{path or 'command line'}: {error}") from error


def _grid(grid: dict, resolution: float | None, size: float | None) -> dict:
    """The grid's settings, lengths rounded up to whole cells where they are not the config's own."""
    cell = resolution if resolution is not None else grid.get("resolution", RESOLUTION)
    lengths = {name: grid.get(name, SIZE) if size is None else size for name in ("length_x", "length_y")}
    numbers = all(isinstance(v, int | float) and math.isfinite(v) and v > 0 for v in (cell, *lengths.values()))
    if not numbers:
        raise ValueError(f"resolution and size must be positive metres, got {cell} and {[*lengths.values()]}")
    cells = math.prod(length / cell for length in lengths.values())
    if cells > MAX_CELLS:
        raise ValueError(f"a map of {cells:,.0f} cells is too large; give a smaller --size or a coarser --resolution")
    whole = {name: cell * math.ceil(length / cell - 1e-6) for name, length in lengths.items()}
    own = {} if resolution is not None or size is not None else grid
    return {**grid, "resolution": cell, **whole, **own}


def _read_yaml(path: Path) -> dict:
    import yaml

    class Loader(yaml.SafeLoader):
        """YAML 1.1 takes 1e-4 for text, for want of a point."""

    number = re.compile(r"^[-+]?(\d+\.?\d*|\.\d+)[eE][-+]?\d+$")
    Loader.add_implicit_resolver("tag:yaml.org,2002:float", number, list("-+.0123456789"))
    try:
        values = yaml.load(path.read_text(encoding="utf-8"), Loader)
    except (OSError, UnicodeDecodeError, yaml.YAMLError) as error:
        raise ValueError(f"{path}: cannot be read as YAML ({error})") from error
    if not isinstance(values, dict | None):
        raise ValueError(f"{path}: expected settings by stage, such as 'grid: {{resolution: 0.1}}'")
    return values or {}
