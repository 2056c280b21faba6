"""Take a map out: `.npz` with every layer and where it lies, `.ply` mesh."""

from __future__ import annotations

import json
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from torchelev.layers import LAYERS

if TYPE_CHECKING:
    from torchelev.elevation_map import ElevationMap

AXES = "layer[i, j]: i grows with +x, j with +y of the map frame; cell centre = center + (i + 0.5 - H/2) * resolution"


class SavedMap(NamedTuple):
    """One map as `save_npz` wrote it."""

    layers: dict[str, NDArray]  # name -> (H, W), NaN where unknown
    resolution: float  # [m]
    center: NDArray[np.float64]  # (3,) [m], map frame
    config: dict[str, Any]  # for ElevationMapConfig.from_dict
    axes: str = AXES

    @property
    def extent(self) -> tuple[float, float, float, float]:
        """Outer borders x_min, x_max, y_min, y_max [m], map frame."""
        return map_extent(next(iter(self.layers.values())).shape, self.center, self.resolution)


def map_extent(shape: tuple[int, ...], center: NDArray, resolution: float) -> tuple[float, float, float, float]:
    """Outer borders x_min, x_max, y_min, y_max [m] of a map of `shape` (H, W) around `center`."""
    half_x, half_y = shape[0] * resolution / 2, shape[1] * resolution / 2
    x, y = float(center[0]), float(center[1])
    return x - half_x, x + half_x, y - half_y, y + half_y


def take(emap: ElevationMap, env: int = 0) -> SavedMap:
    """Copy environment `env` to the host as numpy arrays, layers in the map's precision."""
    layers = {name: emap.layer(name)[env].detach().cpu().numpy() for name in LAYERS}
    center = emap.center[env].detach().cpu().double().numpy()
    return SavedMap(layers, emap.cfg.grid.resolution, center, emap.cfg.to_dict())


def save_npz(path: str | Path, emap: ElevationMap, env: int = 0) -> None:
    """Write environment `env`: each layer (H, W) by its name, and the geometry.

    Beside the layers: `resolution` [m], `center` (3,) [m] in the map frame, `axes` (the convention in words) and
    `config` (JSON). Plain numpy reads it; `load_npz` gives it back as a SavedMap.
    """
    saved = take(emap, env)
    arrays: dict[str, Any] = dict(saved.layers, resolution=saved.resolution, center=saved.center, axes=AXES)
    with Path(path).open("wb") as file:  # a file object: numpy appends .npz to names that lack it
        np.savez_compressed(file, **arrays, config=np.array(json.dumps(saved.config)))


def load_npz(path: str | Path) -> SavedMap:
    """Read what `save_npz` wrote. Raises ValueError if the file holds no map."""
    with np.load(path, allow_pickle=False) as file:
        missing = {"resolution", "center", "axes", "config"} - set(file.files)
        if missing:
            raise ValueError(f"{path}: no map, {', '.join(sorted(missing))} missing; write it with save_npz")
        arrays = {name: file[name] for name in file.files}
    facts = {name: arrays.pop(name) for name in ("resolution", "center", "axes", "config")}
    resolution, config = float(facts["resolution"]), json.loads(str(facts["config"]))
    return SavedMap(arrays, resolution, facts["center"], config, str(facts["axes"]))


def save_mesh(path: str | Path, emap: ElevationMap, env: int = 0, layer: str = "elevation") -> int:
    """Write environment `env` as a triangle mesh (binary `.ply`, metres, map frame, normals up).

    Vertices are the centres of known cells, in float64 so that a mesh far from the origin keeps its shape. Returns the
    number of triangles.
    """
    import plyfile

    heights = emap.layer(layer)[env].detach().cpu().numpy()
    center = emap.center[env].detach().cpu().double().numpy()
    vertices, triangles = triangulate(heights, center, emap.cfg.grid.resolution)
    vertex = np.zeros(len(vertices), dtype=[(axis, "f8") for axis in "xyz"])
    vertex["x"], vertex["y"], vertex["z"] = vertices.T
    face = np.zeros(len(triangles), dtype=[("vertex_indices", "i4", (3,))])
    face["vertex_indices"] = triangles
    elements = [plyfile.PlyElement.describe(vertex, "vertex"), plyfile.PlyElement.describe(face, "face")]
    plyfile.PlyData(elements).write(str(path))
    return len(triangles)


def triangulate(heights: NDArray, center: NDArray, resolution: float) -> tuple[NDArray[np.float64], NDArray[np.int64]]:
    """Join cell centres to triangles: vertices (V, 3) [m], triangles (F, 3) counter-clockwise seen from above.

    `heights` (H, W) [m], NaN where unknown. Only quads whose four corners are known become triangles, so that holes
    stay holes.
    """
    known = np.isfinite(heights)
    number = np.where(known, np.cumsum(known.ravel()).reshape(known.shape) - 1, -1)
    i, j = np.nonzero(known)
    x = center[0] + (i + 0.5 - heights.shape[0] / 2) * resolution
    y = center[1] + (j + 0.5 - heights.shape[1] / 2) * resolution
    vertices = np.stack([x, y, heights[known].astype(np.float64)], axis=-1)
    quads = np.stack([number[:-1, :-1], number[1:, :-1], number[1:, 1:], number[:-1, 1:]], axis=-1).reshape(-1, 4)
    quads = quads[(quads >= 0).all(axis=1)]
    return vertices, np.concatenate([quads[:, [0, 1, 2]], quads[:, [0, 2, 3]]])
