"""The surface between the samples of a height field: bilinear, or two triangles in each cell.

With u and v from 0 to 1 along x and y in the cell, it is z = a + b u + c v + d f(u, v) [m]. At its corners all agree.

| surface | diagonal | f |
|---|---|---|
| bilinear | none | u v |
| triangles | rising, from (0, 0) to (1, 1) | min(u, v) |
| triangles | falling, from (1, 0) to (0, 1) | max(u + v - 1, 0) |
"""

from __future__ import annotations

from enum import IntEnum

import torch
from torch import Tensor

from torchelev.errors import require

Coefficients = tuple[Tensor, Tensor, Tensor, Tensor]  # a, b, c, d

# The one place that says which triangles an engine has. x and y are the axes of the field's own frame: rows of a file
# that are turned over, as MuJoCo reads those of a PNG, turn over the heights, but not the diagonals.
_ENGINES = {
    "mujoco": "rising",  # MuJoCo 4.0, rays and contacts: tests/sim/terrains/test_surfaces.py
    "newton": "rising",  # Newton 1.8, contacts: findings/newton_heightfield_diagonals.sh
    "newton_rays": "falling",  # Newton 1.8, intersect_ray
}


class Surface(IntEnum):
    """How a surface continues between the samples; C++ counts in the same order."""

    BILINEAR = 0
    RISING = 1
    FALLING = 2

    def height(self, coefficients: Coefficients, u: Tensor, v: Tensor) -> Tensor:
        """Return the height [m] at u and v in cells."""
        a, b, c, d = coefficients
        if self is Surface.BILINEAR:
            return a + b * u + (c + d * u) * v
        bend = torch.minimum(u, v) if self is Surface.RISING else (u + v - 1).clamp(min=0)
        return a + b * u + c * v + d * bend


def surface_of(engine: str) -> dict[str, str]:
    """Return the surface that a physics engine makes of a height field, as options of `HeightField`.

    Args:
        engine: "mujoco", "newton" or "newton_rays": Newton's rays see other triangles than its feet stand on. Of other
            engines, cast a ray and drop a small ball on the middle of a cell with two opposite corners raised: the
            diagonal runs where both meet the raised height.

    Raises:
        ValueError: The engine is not known.
    """
    names, hint = ", ".join(_ENGINES), "give surface and diagonal to HeightField yourself"
    require(engine in _ENGINES, "engine", f"must be one of {names}", repr(engine), hint)
    return {"surface": "triangles", "diagonal": _ENGINES[engine]}


def require_surface(surface: str, diagonal: str) -> Surface:
    """Return the surface by its name and diagonal.

    Raises:
        ValueError: There is no surface or diagonal of this name.
    """
    hint = "torchelev.sim.surface_of names those of an engine"
    require(surface in ("bilinear", "triangles"), "surface", "must be bilinear or triangles", repr(surface), hint)
    require(diagonal in ("rising", "falling"), "diagonal", "must be rising or falling", repr(diagonal), hint)
    return Surface.BILINEAR if surface == "bilinear" else Surface[diagonal.upper()]
