"""Export a map: layers as NumPy arrays with their geometry, `.npz` files, and `.ply` meshes and clouds."""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from torchelev.errors import require
from torchelev.files.output_files import MARK, atomic_file
from torchelev.io.map_file import WHOLE, as_array, load_map, map_arrays, read_npz, save_map
from torchelev.state import map_layers

if TYPE_CHECKING:
    from torchelev.elevation_map import ElevationMap

__all__ = [
    "SavedMap",
    "load_map",
    "load_npz",
    "save_cloud",
    "save_map",
    "save_mesh",
    "save_npz",
    "take",
    "to_mesh",
    "to_points",
    "triangulate",
]

_AXES = "layer[i, j]: i grows with +x, j with +y of the map frame; cell centre = center + (i + 0.5 - H/2) * resolution"
_GEOMETRY = ("resolution", "center", "axes", "config")  # arrays of an .npz beside the layers
_HINT = "write it with save_npz"


class SavedMap(NamedTuple):
    """The layers of one environment and their geometry."""

    layers: dict[str, NDArray]  #: name -> (H, W), NaN where unknown
    resolution: float  #: [m]
    center: NDArray[np.float64]  #: (3,) [m], map frame
    config: dict[str, Any]  #: for ElevationMapConfig.from_dict
    axes: str = _AXES  #: how tensor indices relate to the map frame's axes

    @property
    def extent(self) -> tuple[float, float, float, float]:
        """The outer borders x_min, x_max, y_min, y_max [m], map frame."""
        H, W = next(iter(self.layers.values())).shape
        half_x, half_y = H * self.resolution / 2, W * self.resolution / 2
        x, y = float(self.center[0]), float(self.center[1])
        return x - half_x, x + half_x, y - half_y, y + half_y

    def find_cells(self, xy: NDArray) -> tuple[NDArray[np.int64], NDArray[np.int64], NDArray[np.bool_]]:
        """Return the cells i, j (M,) that hold points (M, 2) [m], and which points are inside; others get 0, 0."""
        shape = np.array(next(iter(self.layers.values())).shape)
        cell = np.floor((xy - self.center[:2]) / self.resolution + shape / 2)
        is_inside = np.all((cell >= 0) & (cell < shape), axis=1)
        i, j = np.where(is_inside[:, None], cell, 0).astype(np.int64).T
        return i, j, is_inside

    def cell_center(self, cell: tuple[int, int]) -> tuple[float, float]:
        """Return the centre (x, y) [m] of cell (i, j), map frame."""
        x_min, _, y_min, _ = self.extent
        return x_min + (cell[0] + 0.5) * self.resolution, y_min + (cell[1] + 0.5) * self.resolution


def take(emap: ElevationMap, env: int = 0, layers: Sequence[str] | None = None) -> SavedMap:
    """Copy one environment to NumPy arrays.

    Args:
        emap: the map.
        env: the environment.
        layers: names as in `ElevationMap.layer`; None: all, including those of configured filters.

    Returns:
        The layers in the map's precision (bfloat16 as float32) and their geometry.

    Raises:
        KeyError: a layer does not exist.
        ValueError: the environment does not exist.
    """
    require(0 <= env < emap.num_envs, "env", f"must lie in [0, {emap.num_envs})", env, "environments count from 0")
    names = emap.layers if layers is None else layers
    if emap.channels is None and emap.levels is None:
        state = map_layers(lambda value: value[env : env + 1], emap.state)  # or filters would run for all environments
        arrays = {name: as_array(emap.layer(name, state=state)[0]) for name in names}
    else:  # channels and levels are no part of a state
        arrays = {name: as_array(emap.layer(name)[env]) for name in names}
    center = as_array(emap.center[env])
    return SavedMap(arrays, emap.cfg.grid.resolution, center, emap.cfg.to_dict())


def save_npz(path: str | Path, emap: ElevationMap, env: int = 0) -> None:
    """Write the layers (H, W) of one environment, by their names, to an `.npz` that plain NumPy reads.

    Beside the layers it holds `resolution` [m], `center` (3,) [m] in the map frame, `axes` (the index convention in
    words) and `config` (JSON). `load_npz` reads these back. The arrays that begin with `map_` are the environment as
    `save_map` keeps it, for `load_map`: a map that continues, or that paths are planned on.

    Args:
        path: the file to write, under this name as it is.
        emap: the map.
        env: the environment.

    Raises:
        ValueError: the environment does not exist, or a filter's layer has a reserved name.
        WriteError: the file cannot be written; an existing one is left as it was.
    """
    saved = take(emap, env)
    write_npz(path, saved, map_arrays(emap, slice(env, env + 1)))


def write_npz(path: str | Path, saved: SavedMap, whole: dict[str, Any] | None = None) -> None:
    """Write layers and their geometry, as `save_npz` does, and the arrays of a whole map, if given."""
    reserved = (*_GEOMETRY, "file")  # `file` is an argument of NumPy's savez
    clash = [name for name in saved.layers if name in reserved or name.startswith(WHOLE)]
    rule = f"must not be named {', '.join(reserved)}, or begin with {WHOLE}"
    require(not clash, "layers", rule, ", ".join(clash), "rename the filter's layer")
    config = np.array(json.dumps(saved.config))
    arrays: dict[str, Any] = dict(saved.layers, resolution=saved.resolution, center=saved.center, axes=_AXES)
    arrays |= {WHOLE + name: array for name, array in (whole or {}).items()}
    with atomic_file(path) as file:  # a file object: numpy appends .npz to names that lack it
        np.savez_compressed(file, config=config, **arrays)


def load_npz(path: str | Path) -> SavedMap:
    """Read a file of `save_npz`.

    Args:
        path: the file.

    Returns:
        The layers and their geometry.

    Raises:
        ValueError: not a file of `save_npz`, or a damaged one.
    """
    arrays = {name: array for name, array in read_npz(path, _HINT).items() if not name.startswith(WHOLE)}
    missing = set(_GEOMETRY) - set(arrays)
    if missing:
        raise ValueError(f"{path}: not a map, {', '.join(sorted(missing))} missing; {_HINT}")
    geometry = {name: arrays.pop(name) for name in _GEOMETRY}
    shapes = {array.shape for array in arrays.values()}
    require(len(shapes) == 1 and len(next(iter(shapes))) == 2, str(path), "must hold layers (H, W)", shapes, _HINT)
    try:
        resolution, config = float(geometry["resolution"]), json.loads(str(geometry["config"]))
    except (TypeError, ValueError) as error:
        raise ValueError(f"{path}: damaged resolution or config ({error}); {_HINT}") from error
    center = geometry["center"]
    is_valid = isinstance(config, dict) and resolution > 0 and center.shape == (3,) and center.dtype.kind == "f"
    actual = f"{resolution}, {center.dtype} {center.shape} and a {type(config).__name__}"
    require(is_valid, str(path), "must have a positive resolution, a float center (3,) and a config", actual, _HINT)
    return SavedMap(arrays, resolution, center, config, str(geometry["axes"]))


def to_points(emap: ElevationMap, env: int = 0, layer: str = "elevation") -> NDArray[np.float64]:
    """Return the known cells of one environment as points.

    Args:
        emap: the map.
        env: the environment.
        layer: gives the points' z and which cells are known.

    Returns:
        Points (K, 3) float64 [m], map frame: x and y of the cell centre, and the layer's value.

    Raises:
        KeyError: the layer does not exist.
        ValueError: the environment does not exist.
    """
    saved = take(emap, env, (layer,))
    return _known_points(saved.layers[layer], saved.center, saved.resolution)


def save_cloud(path: str | Path, emap: ElevationMap, env: int = 0, layer: str = "elevation") -> int:
    """Write one environment as a point cloud, a binary `.ply`; see `to_points`.

    Args:
        path: the file to write.
        emap: the map.
        env: the environment.
        layer: gives the points' z.

    Returns:
        The number of points.

    Raises:
        KeyError: the layer does not exist.
        ValueError: the environment does not exist.
        WriteError: the file cannot be written; an existing one is left as it was.
    """
    points = to_points(emap, env, layer)
    write_ply(path, points)
    return len(points)


def to_mesh(
    emap: ElevationMap, env: int = 0, layer: str = "elevation"
) -> tuple[NDArray[np.float64], NDArray[np.int64]]:
    """Return one environment as a triangle mesh; see `triangulate`.

    Args:
        emap: the map.
        env: the environment.
        layer: gives the vertices' z and which cells are known.

    Returns:
        Vertices (V, 3) float64 [m], map frame, and triangles (F, 3), indices of vertices.

    Raises:
        KeyError: the layer does not exist.
        ValueError: the environment does not exist.
    """
    saved = take(emap, env, (layer,))
    return triangulate(saved.layers[layer], saved.center, saved.resolution)


def save_mesh(path: str | Path, emap: ElevationMap, env: int = 0, layer: str = "elevation") -> int:
    """Write one environment as a triangle mesh, a binary `.ply` in metres in the map frame; see `to_mesh`.

    Args:
        path: the file to write.
        emap: the map.
        env: the environment.
        layer: gives the vertices' z.

    Returns:
        The number of triangles.

    Raises:
        KeyError: the layer does not exist.
        ValueError: the environment does not exist.
        WriteError: the file cannot be written; an existing one is left as it was.
    """
    vertices, triangles = to_mesh(emap, env, layer)
    write_ply(path, vertices, triangles)
    return len(triangles)


def triangulate(heights: NDArray, center: NDArray, resolution: float) -> tuple[NDArray[np.float64], NDArray[np.int64]]:
    """Triangulate a height map: two triangles between each four neighbouring cell centres that are all known.

    Unknown cells leave holes.

    Args:
        heights: (H, W) [m], NaN where unknown.
        center: (3,) [m] of the map; z is ignored.
        resolution: [m].

    Returns:
        Vertices (V, 3) [m] at the known cells' centres, and triangles (F, 3), counter-clockwise seen from above.
    """
    is_known = np.isfinite(heights)
    index = np.cumsum(is_known.ravel()).reshape(heights.shape) - 1
    is_square = is_known[:-1, :-1] & is_known[1:, :-1] & is_known[1:, 1:] & is_known[:-1, 1:]
    a, b = index[:-1, :-1][is_square], index[1:, :-1][is_square]
    c, d = index[1:, 1:][is_square], index[:-1, 1:][is_square]
    triangles = np.concatenate([np.stack([a, b, c], 1), np.stack([a, c, d], 1)])
    return _known_points(heights, center, resolution), triangles


def _known_points(heights: NDArray, center: NDArray, resolution: float) -> NDArray[np.float64]:
    """Return the centres of the known cells (K, 3) in float64, precise far from the origin, row by row."""
    i, j = np.nonzero(np.isfinite(heights))
    x = center[0] + (i + 0.5 - heights.shape[0] / 2) * resolution
    y = center[1] + (j + 0.5 - heights.shape[1] / 2) * resolution
    return np.stack([x, y, heights[i, j].astype(np.float64)], axis=-1)


def write_ply(path: str | Path, vertices: NDArray, triangles: NDArray | None = None) -> None:
    """Write vertices (V, 3) and triangles (F, 3), or vertices alone, as a binary `.ply`."""
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
