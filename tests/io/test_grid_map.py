"""Maps in the GridMap convention: the right corner first, and back."""

from types import SimpleNamespace

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from tests.helpers import mapped, small_map
from torchelev.io.grid_map import Dimension, Float32MultiArray, GridMap, Layout, from_grid_map, to_grid_map


def map_of(heights, resolution=0.5, corner=(0, 0)):
    """A map with these heights (H, W), NaN where unknown, whose first cell has these numbers on the lattice."""
    heights = torch.tensor(heights)
    emap = small_map(cells=tuple(heights.shape), resolution=resolution)
    known = torch.isfinite(heights)
    state = emap.state._replace(
        corner=torch.tensor([corner]), elevation=torch.where(known, heights, 0.0)[None], validity=known[None]
    )
    emap.load_state(state)
    return emap


@pytest.fixture
def heights():
    """3 cells along x, 2 along y."""
    return [[1.0, 2.0], [3.0, 4.0], [5.0, 6.0]]


def test_a_known_corner(heights):
    """1.5 m along x from 10, 1 m along y from 20: the cell at x = 11.25, y = 20.75 is 6 m high and comes first."""
    grid_map = to_grid_map(map_of(heights, corner=(20, 40)))
    assert grid_map.info.resolution == 0.5
    assert (grid_map.info.length_x, grid_map.info.length_y) == (1.5, 1.0)
    assert grid_map.info.pose.position == (10.75, 20.5, 0.0)
    assert grid_map.info.pose.orientation == (0.0, 0.0, 0.0, 1.0)
    (array,) = grid_map.data
    # The matrix is [[6, 5], [4, 3], [2, 1]]: rows along -x, columns along -y. It is stored column by column.
    assert array.data.tolist() == [6, 4, 2, 5, 3, 1] and array.data.dtype == np.float32
    assert array.layout.dim == [Dimension("column_index", 2, 6), Dimension("row_index", 3, 3)]
    assert array.layout.data_offset == grid_map.outer_start_index == grid_map.inner_start_index == 0
    assert grid_map.layers == ["elevation"] and grid_map.basic_layers == []


def test_places_of_cells_by_the_formula_of_grid_map():
    """grid_map_core: position = map position + length / 2 - resolution / 2 - resolution * index."""
    emap = mapped(num_envs=2)
    info, _, _, (array,) = to_grid_map(emap, env=1)[:4]
    centers = emap.cell_centers()[1].numpy()
    rows, columns = emap.elevation.shape[1:]
    heights, found = emap.layer("elevation")[1].numpy(), 0
    for r in range(rows):
        for c in range(columns):
            x = info.pose.position.x + info.length_x / 2 - info.resolution / 2 - info.resolution * r
            y = info.pose.position.y + info.length_y / 2 - info.resolution / 2 - info.resolution * c
            distance = np.abs(centers - [x, y]).max(-1)
            i, j = divmod(int(distance.argmin()), columns)
            assert distance[i, j] < 1e-9
            np.testing.assert_equal(array.data[c * rows + r], heights[i, j])
            found += np.isfinite(heights[i, j])
    assert 50 < found < rows * columns


def test_round_trip_of_layers_with_holes():
    emap, names = mapped(num_envs=2), ["elevation", "variance", "validity", "normal_x", "upper_bound"]
    grid_map = to_grid_map(emap, 1, names, basic_layers=["elevation"])
    assert grid_map.layers == names and grid_map.basic_layers == ["elevation"]
    layers, center, resolution = from_grid_map(grid_map)
    assert list(layers) == names and resolution == emap.cfg.grid.resolution
    np.testing.assert_array_equal(center[:2], emap.center[1, :2])
    for name, values in layers.items():
        np.testing.assert_array_equal(values, emap.layer(name)[1])
    assert np.isnan(layers["elevation"]).any()


def message(layer, start, row_major, offset=0, resolution=0.25):
    """A message as another program sends it, cell by cell: objects with attributes, lists of numbers."""
    H, W = layer.shape
    labels, sizes = (("row_index", "column_index"), (H, W)) if row_major else (("column_index", "row_index"), (W, H))
    data = [0.0] * (offset + H * W)
    for r in range(H):
        for c in range(W):
            row, column = (r + start[0]) % H, (c + start[1]) % W
            place = row * W + column if row_major else column * H + row
            data[offset + place] = float(layer[H - 1 - r, W - 1 - c])
    dim = [SimpleNamespace(label=label, size=size, stride=0) for label, size in zip(labels, sizes, strict=True)]
    position = SimpleNamespace(x=1.0, y=2.0, z=0.5)
    return SimpleNamespace(
        info=SimpleNamespace(
            resolution=resolution,
            length_x=H * resolution,
            length_y=W * resolution,
            pose=SimpleNamespace(position=position, orientation=SimpleNamespace(x=0.0, y=0.0, z=0.0, w=0.0)),
        ),
        layers=["elevation"],
        basic_layers=[],
        data=[SimpleNamespace(layout=SimpleNamespace(dim=dim, data_offset=offset), data=data)],
        outer_start_index=start[0],
        inner_start_index=start[1],
    )


@given(st.integers(1, 6), st.integers(1, 6), st.integers(0, 5), st.integers(0, 5), st.booleans(), st.integers(0, 2))
def test_messages_of_others_wherever_their_buffer_starts(H, W, row, column, row_major, offset):
    layer = np.arange(H * W, dtype=np.float32).reshape(H, W)
    layers, center, resolution = from_grid_map(message(layer, (row % H, column % W), row_major, offset))
    np.testing.assert_array_equal(layers["elevation"], layer)
    assert center.tolist() == [1.0, 2.0, 0.5] and resolution == 0.25


def test_what_is_read_is_the_callers(heights):
    grid_map = to_grid_map(map_of(heights))
    from_grid_map(grid_map).layers["elevation"][:] = 0
    assert grid_map.data[0].data.tolist() == [6, 4, 2, 5, 3, 1]


def test_one_cell_and_one_row():
    assert to_grid_map(map_of([[7.0]])).data[0].data.tolist() == [7]
    assert to_grid_map(map_of([[1.0, 2.0, 3.0]])).data[0].data.tolist() == [3, 2, 1]
    assert to_grid_map(map_of([[1.0], [2.0], [3.0]])).data[0].data.tolist() == [3, 2, 1]
    assert np.isnan(to_grid_map(map_of([[np.nan, np.nan]])).data[0].data).all()


# What is refused ------------------------------------------------------------------------------------------------------


def test_refuses_layers_and_environments_that_do_not_exist(heights):
    emap = map_of(heights)
    with pytest.raises(KeyError, match="slope"):
        to_grid_map(emap, layers=["slope"])
    with pytest.raises(ValueError, match="env: must lie in"):
        to_grid_map(emap, env=1)
    with pytest.raises(ValueError, match="basic_layers: must be among the layers"):
        to_grid_map(emap, layers=["time"], basic_layers=["elevation"])


def with_array(grid_map: GridMap, **changes) -> GridMap:
    return grid_map._replace(data=[grid_map.data[0]._replace(**changes)])


def test_refuses_messages_that_do_not_fit(heights):
    good = to_grid_map(map_of(heights))
    data = good.data[0].data
    cases = [
        (good._replace(layers=["elevation", "time"]), "2 layers and 1 data"),
        (good._replace(info=good.info._replace(length_x=2.0)), "must have 4 rows and 2 columns.*got 3 and 2"),
        (good._replace(info=good.info._replace(resolution=0.0)), "resolution: must be positive"),
        (with_array(good, data=data[:-1]), "elevation: must have 2 x 3 values, got 5"),
        (with_array(good, layout=Layout([])), "must be column_index, row_index, got none"),
        (with_array(good, layout=Layout([Dimension("x", 2, 6), Dimension("y", 3, 3)])), "got x, y"),
        (
            with_array(good, layout=Layout([Dimension("row_index", 2, 6), Dimension("column_index", 3, 3)])),
            "got 2 and 3",
        ),
    ]
    for bad, match in cases:
        with pytest.raises(ValueError, match=match):
            from_grid_map(bad)
    assert isinstance(good.data[0], Float32MultiArray)
