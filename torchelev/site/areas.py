"""Place areas of a site on its lattice, and save them, from this process or over the network."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from torchelev.config import ElevationMapConfig
from torchelev.errors import require, whole_cells
from torchelev.grid import grid_of
from torchelev.io.export import SavedMap

if TYPE_CHECKING:
    from torch import Tensor


def require_resolution(resolution: float, of_site: float) -> None:
    """Raise ValueError unless a map's resolution [m] is that of the site."""
    is_same, rule = math.isclose(resolution, of_site, rel_tol=1e-9), f"must have the site's resolution, {of_site:g} m"
    require(is_same, "emap", rule, f"{resolution:g} m", "cells must line up")


def place_area(
    center: Sequence[float] | Tensor, length_x: float, length_y: float, resolution: float
) -> tuple[tuple[int, int], tuple[int, int]]:
    """Return the numbers on the lattice of the first cell of an area, and its size H, W in cells.

    Args:
        center: x, y [m], map frame; the area's centre is the nearest point at which its cells line up.
        length_x: [m], a whole number of cells.
        length_y: [m], a whole number of cells.
        resolution: [m].

    Raises:
        ValueError: a length is not a whole number of cells, or the centre is not a point.
    """
    lengths = {"length_x": length_x, "length_y": length_y}
    height, width = (whole_cells(name, length, resolution) for name, length in lengths.items())
    point = [float(value) for value in center[:2]]
    is_point = len(point) == 2 and all(map(math.isfinite, point))
    require(is_point, "center", "expected x, y in metres", point, "give (0.0, 0.0), say")
    x, y = (math.floor(c / resolution - n / 2 + 0.5) for c, n in zip(point, (height, width), strict=True))
    return (x, y), (height, width)


def save_area(
    layers: Mapping[str, NDArray], corner: tuple[int, int], size: tuple[int, int], resolution: float, **kept: Any
) -> SavedMap:
    """Return an area whose first cell has these numbers on the lattice.

    Args:
        layers: (H, W) each.
        corner: numbers of the first cell.
        size: H, W.
        resolution: [m].
        kept: what the site keeps besides heights, as of `ElevationMapConfig`.
    """
    middle = [(c + n / 2) * resolution for c, n in zip(corner, size, strict=True)]
    config = ElevationMapConfig(grid=grid_of(size, resolution), **kept).to_dict()
    return SavedMap(dict(layers), resolution, np.array([*middle, 0.0]), config)
