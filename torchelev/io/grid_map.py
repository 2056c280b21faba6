"""Convert maps to and from ROS's GridMap convention, without importing ROS.

`GridMap` has the same fields as the message grid_map_msgs/GridMap, except for the header: frame and timestamp are up to
the caller. `from_grid_map` also reads received messages.

A layer of a GridMap is a matrix whose element (0, 0) is the cell with the largest x and y. The row index grows along
-x, the column index along -y, and values are stored column by column (grid_map_core's GridMapMath, grid_map_ros'
GridMapMsgHelpers):

    matrix[r, c] = layer[H - 1 - r, W - 1 - c]        data[c * H + r] = matrix[r, c]
"""

from __future__ import annotations

import warnings
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from numpy.typing import NDArray

from torchelev.errors import require
from torchelev.levels import LAYERS as LEVEL_LAYERS

if TYPE_CHECKING:
    from torchelev.elevation_map import ElevationMap

_COLUMN, _ROW = "column_index", "row_index"
_TOLERANCE = 1e-3  # [cells] by which a length may differ from a whole number of cells


class Point(NamedTuple):
    """Same fields as geometry_msgs/Point [m]."""

    x: float  #: [m]
    y: float  #: [m]
    z: float = 0.0  #: [m] 0 in a GridMap, whose heights are absolute


class Quaternion(NamedTuple):
    """Same fields as geometry_msgs/Quaternion; the identity in a GridMap."""

    x: float = 0.0  #: vector part, x
    y: float = 0.0  #: vector part, y
    z: float = 0.0  #: vector part, z
    w: float = 1.0  #: scalar part


class Pose(NamedTuple):
    """Same fields as geometry_msgs/Pose."""

    position: Point  #: of the map's centre
    orientation: Quaternion = Quaternion()  #: of the map


class GridMapInfo(NamedTuple):
    """Same fields as grid_map_msgs/GridMapInfo."""

    resolution: float  #: [m]
    length_x: float  #: [m]
    length_y: float  #: [m]
    pose: Pose  #: of the map's centre


class Dimension(NamedTuple):
    """Same fields as std_msgs/MultiArrayDimension."""

    label: str  #: "column_index" or "row_index"
    size: int  #: number of entries
    stride: int  #: product of the sizes of this and all faster dimensions


class Layout(NamedTuple):
    """Same fields as std_msgs/MultiArrayLayout."""

    dim: list[Dimension]  #: slowest first
    data_offset: int = 0  #: entries before the first


class Float32MultiArray(NamedTuple):
    """Same fields as std_msgs/Float32MultiArray."""

    layout: Layout  #: dimensions of the data
    data: NDArray[np.float32]  #: (H * W,)


class GridMap(NamedTuple):
    """Same fields as grid_map_msgs/GridMap, except for the header."""

    info: GridMapInfo  #: resolution, size and pose
    layers: list[str]  #: names, in the order of the data
    basic_layers: list[str]  #: layers that must be known for a cell to be valid
    data: list[Float32MultiArray]  #: one per layer, NaN where unknown
    outer_start_index: int = 0  #: row of the circular buffer with the matrix's first row
    inner_start_index: int = 0  #: column of the circular buffer with the matrix's first column


class MapLayers(NamedTuple):
    """Layers of a GridMap in torchelev's convention."""

    layers: dict[str, NDArray[np.float32]]  #: name -> (H, W): i grows with +x, j with +y
    center: NDArray[np.float64]  #: (3,) [m], frame of the GridMap
    resolution: float  #: [m]


def to_grid_map(
    emap: ElevationMap,
    env: int = 0,
    layers: Sequence[str] = ("elevation",),
    basic_layers: Sequence[str] = (),
) -> GridMap:
    """Copy layers of one environment to a GridMap, in float32, NaN where unknown.

    The pose is the window's centre with z = 0, as in GridMap's own converter. The channel of a colour becomes one
    layer, whose floats hold the bits 0x00RRGGBB, as RViz reads them.

    Args:
        emap: the map.
        env: the environment.
        layers: names as in `ElevationMap.layer`; of channels with several components, those of the components.
        basic_layers: those of the layers that must be known for a cell to be valid.

    Returns:
        The GridMap.

    Raises:
        KeyError: a layer does not exist.
        ValueError: the environment does not exist, a basic layer is not among the layers, or a layer is a channel of
            several components that is no colour.
    """
    is_sequence = not isinstance(layers, str)
    require(is_sequence, "layers", "must be a sequence of names", repr(layers), f"give ({layers!r},)")
    is_subset = set(basic_layers) <= set(layers)
    names = ", ".join(layers)
    require(is_subset, "basic_layers", "must be among the layers", list(basic_layers), f"layers are {names}")
    from torchelev.io.export import take  # which needs PyTorch

    taken = take(emap, env, layers)
    values = {name: _flat(name, taken.layers[name], emap) for name in layers}
    return grid_map_of(values, taken.center.tolist(), emap.cfg.grid.resolution, basic_layers)


def _flat(name: str, values: NDArray, emap: ElevationMap) -> NDArray:
    """Return a layer (H, W): a colour (3, H, W) packed, all else as it is."""
    if values.ndim == 2:
        return values
    cfg = emap.cfg.channels[name]
    hint = f"give {', '.join(cfg.components(name))}"
    require(cfg.is_color, "layers", "must have one value for each cell", f"{name!r} with {cfg.size}", hint)
    return pack_colors(values)


def pack_colors(rgb: NDArray) -> NDArray[np.float32]:
    """Return colours (3, H, W) from 0 to 1 as floats whose bits are 0x00RRGGBB; NaN stays NaN."""
    red, green, blue = np.round(255 * np.nan_to_num(rgb).clip(0, 1)).astype(np.uint32)
    packed = (red << 16 | green << 8 | blue).view(np.float32)
    return np.where(np.isnan(rgb).any(0), np.float32(np.nan), packed)


def grid_map_of(
    layers: Mapping[str, NDArray], center: Sequence[float], resolution: float, basic_layers: Sequence[str] = ()
) -> GridMap:
    """Return the GridMap of layers (H, W), NaN where unknown, and where a ceiling is infinite: nothing hangs there.

    Args:
        layers: by name.
        center: x, y [m] of the window's centre.
        resolution: [m] of a cell.
        basic_layers: those of the layers that must be known for a cell to be valid.
    """
    rows, columns = next(iter(layers.values())).shape
    place = Pose(Point(float(center[0]), float(center[1])))
    info = GridMapInfo(resolution, rows * resolution, columns * resolution, place)
    finite = {n: np.where(np.isinf(v), np.nan, v) if n in LEVEL_LAYERS else v for n, v in layers.items()}
    data = [_to_multi_array(layer) for layer in finite.values()]
    return GridMap(info, list(layers), list(basic_layers), data)


def from_grid_map(grid_map: GridMap) -> MapLayers:
    """Read a GridMap or a received message grid_map_msgs/GridMap, with any start of its circular buffer.

    The orientation is ignored, as grid_map_ros does: a GridMap is aligned with its frame. A warning says so.

    Args:
        grid_map: the GridMap or message.

    Returns:
        The layers in torchelev's convention.

    Raises:
        ValueError: sizes or storage order are inconsistent.
    """
    info = grid_map.info
    is_complete = len(grid_map.layers) == len(grid_map.data)
    actual = f"{len(grid_map.layers)} layers and {len(grid_map.data)} data"
    require(is_complete, "grid_map", "must have data for each layer", actual, "check its publisher")
    turn = info.pose.orientation
    if abs(turn.x) + abs(turn.y) + abs(turn.z) > 1e-6:
        warnings.warn("grid_map: its orientation is ignored, as a GridMap is aligned with its frame", stacklevel=2)
    start = int(grid_map.outer_start_index), int(grid_map.inner_start_index)
    layers = {}
    for name, array in zip(grid_map.layers, grid_map.data, strict=True):
        matrix = _to_matrix(name, array)
        _require_size(name, matrix.shape, info)
        layers[name] = _flip(np.roll(matrix, (-start[0], -start[1]), (0, 1)))
    position = info.pose.position
    return MapLayers(layers, np.array([position.x, position.y, position.z], dtype=np.float64), float(info.resolution))


def _flip(layer: NDArray) -> NDArray[np.float32]:
    """Convert between torchelev's [i, j] and GridMap's matrix: both axes are reversed."""
    return np.ascontiguousarray(layer[::-1, ::-1], dtype=np.float32)


def _to_multi_array(layer: NDArray) -> Float32MultiArray:
    rows, columns = layer.shape
    layout = Layout([Dimension(_COLUMN, columns, rows * columns), Dimension(_ROW, rows, rows)])
    return Float32MultiArray(layout, _flip(layer).ravel(order="F"))


def _to_matrix(name: str, array: Float32MultiArray) -> NDArray[np.float32]:
    """Return a layer's matrix as stored in the circular buffer."""
    labels = [dim.label for dim in array.layout.dim]
    is_known = labels in ([_COLUMN, _ROW], [_ROW, _COLUMN])
    hint = "label them as grid_map_ros does"
    require(is_known, f"grid_map, {name}", f"dimensions must be {_COLUMN}, {_ROW}", ", ".join(labels) or "none", hint)
    sizes = tuple(int(dim.size) for dim in array.layout.dim)
    data = np.asarray(array.data, dtype=np.float32)[array.layout.data_offset :]
    has_size = data.size == sizes[0] * sizes[1] > 0
    require(
        has_size, f"grid_map, {name}", f"must have {sizes[0]} x {sizes[1]} values", data.size, "check its publisher"
    )
    slow_first = data.reshape(sizes)
    return slow_first if labels == [_ROW, _COLUMN] else slow_first.T


def _require_size(name: str, shape: tuple[int, ...], info: GridMapInfo) -> None:
    require(info.resolution > 0, "grid_map, resolution", "must be positive", info.resolution, "give metres")
    expected = info.length_x / info.resolution, info.length_y / info.resolution
    has_size = all(abs(number - size) < _TOLERANCE for number, size in zip(expected, shape, strict=True))
    rule = f"must have {expected[0]:g} rows and {expected[1]:g} columns, as its lengths say"
    require(has_size, f"grid_map, {name}", rule, f"{shape[0]} and {shape[1]}", "check its publisher")
