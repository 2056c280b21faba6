"""Take a map out: layers as arrays and where they lie, `.npz` of them or of the whole map, `.ply` mesh and cloud."""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from torchelev.errors import require
from torchelev.io.map_file import as_array, load_map, read_npz, save_map
from torchelev.output_files import MARK, atomic_file

if TYPE_CHECKING:
    from torchelev.elevation_map import ElevationMap

__all__ = [
    "AXES",
    "SavedMap",
    "load_map",
    "load_npz",
    "map_extent",
    "save_cloud",
    "save_map",
    "save_mesh",
    "save_npz",
    "take",
    "to_mesh",
    "to_points",
    "triangulate",
]

AXES = "layer[i, j]: i grows with +x, j with +y of the map frame; cell centre = center + (i + 0.5 - H/2) * resolution"
FACTS = ("resolution", "center", "axes", "config")  # what an .npz holds beside the layers

MEND = "write it with save_npz"


class SavedMap(NamedTuple):
    """One map as `save_npz` wrote it."""

    layers: dict[str, NDArray]  #: name -> (H, W), NaN where unknown
    resolution: float  #: [m]
    center: NDArray[np.float64]  #: (3,) [m], map frame
    config: dict[str, Any]  #: for ElevationMapConfig.from_dict
    axes: str = AXES  #: how tensor indices relate to the map frame's axes

    @property
    def extent(self) -> tuple[float, float, float, float]:
        """Outer borders x_min, x_max, y_min, y_max [m], map frame."""
        return map_extent(next(iter(self.layers.values())).shape, self.center, self.resolution)


def map_extent(shape: tuple[int, ...], center: NDArray, resolution: float) -> tuple[float, float, float, float]:
    """Outer borders x_min, x_max, y_min, y_max [m] of a map of `shape` (H, W) around `center`."""
    half_x, half_y = shape[0] * resolution / 2, shape[1] * resolution / 2
    x, y = float(center[0]), float(center[1])
    return x - half_x, x + half_x, y - half_y, y + half_y


def take(emap: ElevationMap, env: int = 0, layers: Sequence[str] | None = None) -> SavedMap:
    """Copy environment `env` to the host as numpy arrays, layers in the map's precision (bfloat16 as float32).

    `layers` are names as of `ElevationMap.layer`; None takes all, those of configured filters too. Raises KeyError for
    an unknown layer, ValueError for an environment that does not exist.
    """
    require(0 <= env < emap.num_envs, "env", f"must lie in [0, {emap.num_envs})", env, "environments count from 0")
    arrays = {name: as_array(emap.layer(name)[env].clone()) for name in (emap.layers if layers is None else layers)}
    center = as_array(emap.center[env])
    return SavedMap(arrays, emap.cfg.grid.resolution, center, emap.cfg.to_dict())


def save_npz(path: str | Path, emap: ElevationMap, env: int = 0) -> None:
    """Write environment `env`: each layer (H, W) by its name, and the geometry.

    Beside the layers: `resolution` [m], `center` (3,) [m] in the map frame, `axes` (the convention in words) and
    `config` (JSON). Plain numpy reads it; `load_npz` gives it back as a SavedMap. Raises ValueError for a
    filter's layer with one of these names.
    """
    saved = take(emap, env)
    clash = [name for name in (*FACTS, "file") if name in saved.layers]  # savez has a parameter of that name
    rule = f"must not be named {', '.join(FACTS)}, file"
    require(not clash, "layers", rule, ", ".join(clash), "rename the filter's layer")
    config = np.array(json.dumps(saved.config))
    arrays: dict[str, Any] = dict(saved.layers, resolution=saved.resolution, center=saved.center, axes=AXES)
    with atomic_file(path) as file:  # a file object: numpy appends .npz to names that lack it
        np.savez_compressed(file, config=config, **arrays)


def load_npz(path: str | Path) -> SavedMap:
    """Read what `save_npz` wrote. Raises ValueError if the file holds no map."""
    arrays = read_npz(path, MEND)
    missing = set(FACTS) - set(arrays)
    if missing:
        raise ValueError(f"{path}: no map, {', '.join(sorted(missing))} missing; {MEND}")
    facts = {name: arrays.pop(name) for name in FACTS}
    shapes = {array.shape for array in arrays.values()}
    require(len(shapes) == 1 and len(next(iter(shapes))) == 2, str(path), "must hold layers (H, W)", shapes, MEND)
    try:
        resolution, config = float(facts["resolution"]), json.loads(str(facts["config"]))
    except (TypeError, ValueError) as error:
        raise ValueError(f"{path}: damaged resolution or config ({error}); {MEND}") from error
    center = facts["center"]
    good = isinstance(config, dict) and resolution > 0 and center.shape == (3,) and center.dtype.kind == "f"
    require(good, str(path), "must have a resolution, a center (3,) and a config", "others", MEND)
    return SavedMap(arrays, resolution, facts["center"], config, str(facts["axes"]))


def to_points(emap: ElevationMap, env: int = 0, layer: str = "elevation") -> NDArray[np.float64]:
    """Return the known cells of environment `env` as points (K, 3) [m], map frame: centre x, y and the layer's value.

    In float64, so that points far from the origin keep their place. Raises as `take`.
    """
    saved = take(emap, env, (layer,))
    return _known_points(saved.layers[layer], saved.center, saved.resolution)


def save_cloud(path: str | Path, emap: ElevationMap, env: int = 0, layer: str = "elevation") -> int:
    """Write environment `env` as a point cloud (binary `.ply`, the points of `to_points`). Returns their number."""
    points = to_points(emap, env, layer)
    _write_ply(path, points)
    return len(points)


def to_mesh(
    emap: ElevationMap, env: int = 0, layer: str = "elevation"
) -> tuple[NDArray[np.float64], NDArray[np.int64]]:
    """Return environment `env` as a triangle mesh: vertices (V, 3) [m], map frame, triangles (F, 3); see `triangulate`.

    Raises as `take`.
    """
    saved = take(emap, env, (layer,))
    return triangulate(saved.layers[layer], saved.center, saved.resolution)


def save_mesh(path: str | Path, emap: ElevationMap, env: int = 0, layer: str = "elevation") -> int:
    """Write environment `env` as a triangle mesh (binary `.ply`, metres, map frame, normals up).

    Vertices are the centres of known cells, in float64 so that a mesh far from the origin keeps its shape. Returns the
    number of triangles.
    """
    vertices, triangles = to_mesh(emap, env, layer)
    _write_ply(path, vertices, triangles)
    return len(triangles)


def triangulate(heights: NDArray, center: NDArray, resolution: float) -> tuple[NDArray[np.float64], NDArray[np.int64]]:
    """Join cell centres to triangles: vertices (V, 3) [m], triangles (F, 3) counter-clockwise seen from above.

    `heights` (H, W) [m], NaN where unknown. Only quads whose four corners are known become triangles, so that holes
    stay holes.
    """
    known = np.isfinite(heights)
    number = np.where(known, np.cumsum(known.ravel()).reshape(known.shape) - 1, -1)
    quads = np.stack([number[:-1, :-1], number[1:, :-1], number[1:, 1:], number[:-1, 1:]], axis=-1).reshape(-1, 4)
    quads = quads[(quads >= 0).all(axis=1)]
    triangles = np.concatenate([quads[:, [0, 1, 2]], quads[:, [0, 2, 3]]])
    return _known_points(heights, center, resolution), triangles


def _known_points(heights: NDArray, center: NDArray, resolution: float) -> NDArray[np.float64]:
    """Return the centres of the known cells (K, 3), row by row."""
    i, j = np.nonzero(np.isfinite(heights))
    x = center[0] + (i + 0.5 - heights.shape[0] / 2) * resolution
    y = center[1] + (j + 0.5 - heights.shape[1] / 2) * resolution
    return np.stack([x, y, heights[i, j].astype(np.float64)], axis=-1)


def _write_ply(path: str | Path, vertices: NDArray, triangles: NDArray | None = None) -> None:
    import plyfile

    vertex = np.zeros(len(vertices), dtype=[(axis, "f8") for axis in "xyz"])
    vertex["x"], vertex["y"], vertex["z"] = vertices.T
    elements = [plyfile.PlyElement.describe(vertex, "vertex")]
    if triangles is not None:
        face = np.zeros(len(triangles), dtype=[("vertex_indices", "i4", (3,))])
        face["vertex_indices"] = triangles
        elements.append(plyfile.PlyElement.describe(face, "face"))
    with atomic_file(path) as file:
        plyfile.PlyData(elements, comments=[f"written by {MARK}"]).write(file)
