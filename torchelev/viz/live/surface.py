"""Meshes of a map, and the cell that a ray of sight meets."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from torchelev.io.export import SavedMap, triangulate


def surface(saved: SavedMap, colors: NDArray[np.uint8], origin: NDArray[np.float64]) -> bytes:
    """Return the elevation as a glTF file with a colour at each vertex; unknown cells are holes.

    Args:
        saved: the map.
        colors: (H, W, 4) sRGB.
        origin: (3,) [m] that vertices count from, so that float32 is precise far from the map's origin.
    """
    import trimesh

    heights = saved.layers["elevation"]
    vertices, triangles = triangulate(heights, saved.center, saved.resolution)
    if not len(triangles):
        return b""
    linear = _LINEAR[colors[np.isfinite(heights)]]  # glTF has linear colours
    mesh = trimesh.Trimesh(vertices - origin, triangles, vertex_colors=linear, process=False)
    glb: Any = mesh.export(file_type="glb", tree_postprocessor=_make_matt)
    return glb


def _make_matt(tree: dict[str, Any]) -> None:
    """Give the meshes of a glTF file a matt material; without one they are of metal, which shows only reflections."""
    tree["materials"] = [{"pbrMetallicRoughness": {"metallicFactor": 0, "roughnessFactor": 1}}]
    for mesh in tree["meshes"]:
        for part in mesh["primitives"]:
            part["material"] = 0


_SRGB = np.arange(256) / 255
_LINEAR = np.where(_SRGB <= 0.04045, _SRGB / 12.92, ((_SRGB + 0.055) / 1.055) ** 2.4)
_LINEAR = np.rint(255 * _LINEAR).astype(np.uint8)


def bound_sheet(saved: SavedMap, origin: NDArray[np.float64]) -> tuple[NDArray[np.float32], NDArray[np.uint32]]:
    """Return vertices and triangles of the upper bound where the elevation is unknown, up to the known cells."""
    is_known = np.isfinite(saved.layers["elevation"])
    vertices, triangles = triangulate(saved.layers["upper_bound"], saved.center, saved.resolution)
    known_vertex = is_known[np.isfinite(saved.layers["upper_bound"])]
    triangles = triangles[~known_vertex[triangles].all(1)]
    return (vertices - origin).astype(np.float32), triangles.astype(np.uint32)


def ceiling_sheet(saved: SavedMap, origin: NDArray[np.float64]) -> tuple[NDArray[np.float32], NDArray[np.uint32]]:
    """Return vertices and triangles of the ceilings of a map with levels; none of another one."""
    heights = saved.layers.get("ceiling", np.full_like(saved.layers["elevation"], np.nan))
    vertices, triangles = triangulate(np.where(np.isinf(heights), np.nan, heights), saved.center, saved.resolution)
    return (vertices - origin).astype(np.float32), triangles.astype(np.uint32)


def find_cell(saved: SavedMap, start: NDArray[np.float64], direction: NDArray[np.float64]) -> tuple[int, int] | None:
    """Return the first cell (i, j) whose elevation a ray meets from above, or None.

    Args:
        saved: the map.
        start: (3,) [m], map frame.
        direction: (3,), of any length.
    """
    heights, step = saved.layers["elevation"], saved.resolution / 4
    reach = float(np.linalg.norm(start - saved.center)) + 2 * max(heights.shape) * saved.resolution
    points = start + np.arange(0, reach, step)[:, None] * (direction / np.linalg.norm(direction))
    i, j, is_inside = saved.find_cells(points[:, :2])
    above = points[:, 2] - np.where(is_inside, heights[i, j], np.nan)
    met = np.flatnonzero(above <= 0)[:1]  # never at NaN
    # A ray that was not above known ground before has come in through a hole or the side, under the surface.
    is_hit = len(met) and met[0] > 0 and above[met[0] - 1] > 0
    return (int(i[met[0]]), int(j[met[0]])) if is_hit else None
