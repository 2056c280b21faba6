"""The GridMap convention of ROS: the one place where axes flip.

`GridMap` has the fields of the message grid_map_msgs/GridMap by their names, less its header: frame and time are the
caller's. Nothing of ROS is imported; `from_grid_map` reads a received message as well.

A layer of a GridMap is a matrix whose element (0, 0) is the cell with the largest x and the largest y. Rows go along
-x, columns along -y, and it is stored column by column (grid_map_core's GridMapMath, grid_map_ros' GridMapMsgHelpers):

    matrix[r, c] = layer[H - 1 - r, W - 1 - c]        data[c * H + r] = matrix[r, c]
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from numpy.typing import NDArray

from torchelev.errors import require
from torchelev.io.export import take

if TYPE_CHECKING:
    from torchelev.elevation_map import ElevationMap

COLUMN, ROW = "column_index", "row_index"
SLACK = 1e-3  # cells by which a length may miss a whole number


class Point(NamedTuple):
    """As geometry_msgs/Point [m]."""

    x: float  #: [m]
    y: float  #: [m]
    z: float = 0.0  #: GridMap has none: heights are absolute


class Quaternion(NamedTuple):
    """As geometry_msgs/Quaternion; a GridMap does not turn."""

    x: float = 0.0  #: of the unit quaternion x, y, z, w
    y: float = 0.0  #: see x
    z: float = 0.0  #: see x
    w: float = 1.0  #: see x


class Pose(NamedTuple):
    """As geometry_msgs/Pose."""

    position: Point  #: of the map's centre
    orientation: Quaternion = Quaternion()  #: of the map


class GridMapInfo(NamedTuple):
    """As grid_map_msgs/GridMapInfo."""

    resolution: float  #: [m]
    length_x: float  #: [m]
    length_y: float  #: [m]
    pose: Pose  #: of the map's centre


class Dimension(NamedTuple):
    """As std_msgs/MultiArrayDimension."""

    label: str  #: "column_index" or "row_index"
    size: int  #: number of entries
    stride: int  #: entries of this dimension and all faster ones


class Layout(NamedTuple):
    """As std_msgs/MultiArrayLayout: the slow dimension first."""

    dim: list[Dimension]  #: outermost first
    data_offset: int = 0  #: entries before the first


class Float32MultiArray(NamedTuple):
    """As std_msgs/Float32MultiArray."""

    layout: Layout  #: of the data
    data: NDArray[np.float32]  #: (H * W,)


class GridMap(NamedTuple):
    """As grid_map_msgs/GridMap, less its header."""

    info: GridMapInfo  #: frame, size and pose
    layers: list[str]  #: names, in the order of the data
    basic_layers: list[str]  #: must be known for a cell to count as valid
    data: list[Float32MultiArray]  #: one per layer, NaN where unknown
    outer_start_index: int = 0  #: row of the buffer that holds the first row
    inner_start_index: int = 0  #: column of the buffer that holds the first column


class MapLayers(NamedTuple):
    """What `from_grid_map` found, in torchelev's convention."""

    layers: dict[str, NDArray[np.float32]]  #: name -> (H, W): i grows with +x, j with +y
    center: NDArray[np.float64]  #: (3,) [m]
    resolution: float  #: [m]


def to_grid_map(
    emap: ElevationMap,
    env: int = 0,
    layers: Sequence[str] = ("elevation",),
    basic_layers: Sequence[str] = (),
) -> GridMap:
    """Copy layers of one environment into the GridMap convention, in float32, NaN where unknown.

    The pose is the window's centre, without its z, as GridMap's own converter writes it. Raises KeyError for an unknown
    layer, ValueError for an environment that does not exist and for basic layers that are not among the layers.
    """
    names = not isinstance(layers, str)
    require(names, "layers", "must be a sequence of names", repr(layers), f"give ({layers!r},)")
    among = set(basic_layers) <= set(layers)
    require(among, "basic_layers", "must be among the layers", list(basic_layers), f"layers are {', '.join(layers)}")
    taken, grid = take(emap, env, layers), emap.cfg.grid
    center = Point(float(taken.center[0]), float(taken.center[1]))
    lengths = grid.height * grid.resolution, grid.width * grid.resolution
    info = GridMapInfo(grid.resolution, *lengths, Pose(center))
    data = [_to_multi_array(taken.layers[name]) for name in layers]
    return GridMap(info, list(layers), list(basic_layers), data)


def from_grid_map(grid_map: GridMap) -> MapLayers:
    """Read a GridMap, or a received message grid_map_msgs/GridMap, wherever its circular buffer starts.

    The orientation is not read: a GridMap's axes are those of its frame. Raises ValueError for a message whose sizes or
    storage order do not fit.
    """
    info = grid_map.info
    same = len(grid_map.layers) == len(grid_map.data)
    actual = f"{len(grid_map.layers)} layers and {len(grid_map.data)} data"
    require(same, "grid_map", "must have data for each layer", actual, "check its publisher")
    start = int(grid_map.outer_start_index), int(grid_map.inner_start_index)
    layers = {}
    for name, array in zip(grid_map.layers, grid_map.data, strict=True):
        matrix = _matrix(name, array)
        _require_size(name, matrix.shape, info)
        layers[name] = _flipped(np.roll(matrix, (-start[0], -start[1]), (0, 1)))
    position = info.pose.position
    return MapLayers(layers, np.array([position.x, position.y, position.z], dtype=np.float64), float(info.resolution))


def _flipped(layer: NDArray) -> NDArray[np.float32]:
    """Turn torchelev's [i, j] into GridMap's matrix, or back: both axes run the other way."""
    return np.ascontiguousarray(layer[::-1, ::-1], dtype=np.float32)


def _to_multi_array(layer: NDArray) -> Float32MultiArray:
    rows, columns = layer.shape
    layout = Layout([Dimension(COLUMN, columns, rows * columns), Dimension(ROW, rows, rows)])
    return Float32MultiArray(layout, _flipped(layer).ravel(order="F"))


def _matrix(name: str, array: Float32MultiArray) -> NDArray[np.float32]:
    """Return a layer's matrix as it lies in the circular buffer."""
    labels = [dim.label for dim in array.layout.dim]
    known = labels in ([COLUMN, ROW], [ROW, COLUMN])
    hint = "label them as grid_map_ros does"
    require(known, f"grid_map, {name}", f"dimensions must be {COLUMN}, {ROW}", ", ".join(labels) or "none", hint)
    sizes = tuple(int(dim.size) for dim in array.layout.dim)
    data = np.asarray(array.data, dtype=np.float32)[array.layout.data_offset :]
    fits = data.size == sizes[0] * sizes[1] > 0
    require(fits, f"grid_map, {name}", f"must have {sizes[0]} x {sizes[1]} values", data.size, "check its publisher")
    slow_first = data.reshape(sizes)
    return slow_first if labels == [ROW, COLUMN] else slow_first.T


def _require_size(name: str, shape: tuple[int, ...], info: GridMapInfo) -> None:
    require(info.resolution > 0, "grid_map, resolution", "must be positive", info.resolution, "give metres")
    cells = info.length_x / info.resolution, info.length_y / info.resolution
    fits = all(abs(number - size) < SLACK for number, size in zip(cells, shape, strict=True))
    expected = f"must have {cells[0]:g} rows and {cells[1]:g} columns, as its lengths say"
    require(fits, f"grid_map, {name}", expected, f"{shape[0]} and {shape[1]}", "check its publisher")
