"""Settings of the command line: a YAML or JSON file by stage, overridden by --resolution and --size."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

from torchelev.config import ElevationMapConfig
from torchelev.files.config_files import read_settings

_RESOLUTION, _SIZE = 0.1, 20.0  # [m] defaults
_MAX_CELLS = 16_000_000  # an update takes about 350 bytes of memory per cell


def load_config(path: Path | None, resolution: float | None, size: float | None) -> ElevationMapConfig:
    """Read settings from YAML or JSON and apply the command line's grid options.

    Args:
        path: YAML or JSON file with fields of ElevationMapConfig; None: defaults.
        resolution: [m] cell size; None: the file's, or 0.1.
        size: [m] side length, rounded up to whole cells; None: the file's, or 20.

    Returns:
        The settings.

    Raises:
        ValueError: the file cannot be read, holds an unknown or invalid setting, or the map would be too large.
    """
    values = {} if path is None else read_settings(path)
    grid = values.get("grid") or {}
    if not isinstance(grid, dict):
        raise ValueError(f"{path}: config.grid must be a mapping; see ElevationMapConfig")
    try:
        return ElevationMapConfig.from_dict({**values, "grid": _override_grid(grid, resolution, size)})
    except (ValueError, TypeError) as error:
        raise ValueError(f"{path or 'command line'}: {error}") from error


def _override_grid(grid: dict[str, Any], resolution: float | None, size: float | None) -> dict[str, Any]:
    """Return the grid's settings. Lengths are rounded up to whole cells unless all of them come from the file."""
    cell = resolution if resolution is not None else grid.get("resolution", _RESOLUTION)
    lengths = {name: grid.get(name, _SIZE) if size is None else size for name in ("length_x", "length_y")}
    are_positive = all(isinstance(v, int | float) and math.isfinite(v) and v > 0 for v in (cell, *lengths.values()))
    if not are_positive:
        raise ValueError(f"resolution and size must be positive, got {cell} and {[*lengths.values()]}; give metres")
    num_cells = math.prod(length / cell for length in lengths.values())
    if num_cells > _MAX_CELLS:
        raise ValueError(
            f"a map of {num_cells:,.0f} cells is too large; give a smaller --size or a coarser --resolution"
        )
    rounded = {name: cell * math.ceil(length / cell - 1e-6) for name, length in lengths.items()}
    from_file = {} if resolution is not None or size is not None else grid
    return {**grid, "resolution": cell, **rounded, **from_file}
