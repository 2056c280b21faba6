"""GridMaps in bags and as bytes, of ROS 1 and ROS 2: written and read back to the bit."""

import warnings

import numpy as np
import pytest

from tests.helpers import mapped
from torchelev.io import GridMapWriter, RecordingError, read_grid_map, read_grid_maps, write_grid_map
from torchelev.io.bags import Bag, from_bytes, to_bytes
from torchelev.io.bags.writing import BagWriter
from torchelev.io.grid_map import to_grid_map

PATHS = ["map.bag", "map.mcap", "map.db3", "map"]


def assert_equal(read, emap, env=0):
    assert set(read.layers) == set(emap.layers)
    for name in emap.layers:
        np.testing.assert_array_equal(read.layers[name], emap.layer(name)[env].numpy())
    assert read.resolution == emap.cfg.grid.resolution
    np.testing.assert_array_equal(read.center[:2], emap.center[env, :2].numpy())


@pytest.mark.slow(1)
@pytest.mark.parametrize("name", PATHS)
def test_what_is_written_is_read_back_to_the_bit(tmp_path, name):
    emap = mapped(num_envs=2)
    write_grid_map(tmp_path / name, emap, env=1, frame="odom", stamp=12.25)
    read = read_grid_map(tmp_path / name)
    assert_equal(read, emap, env=1)
    assert (read.frame, read.stamp) == ("odom", 12.25)
    assert [path.name for path in tmp_path.iterdir()] == [name]


@pytest.mark.parametrize("ros", [1, 2])
def test_bytes(ros):
    emap = mapped()
    assert_equal(from_bytes(to_bytes(to_grid_map(emap, layers=emap.layers), 3.5, "map", ros), ros), emap)


@pytest.mark.parametrize("name", ["map.bag", "map.mcap"])
def test_a_growing_map_and_its_costs(tmp_path, name):
    emap = mapped()
    with GridMapWriter(tmp_path / name, ("elevation",), frame="odom", occupancy_topic="/costs") as writer:
        for k in range(3):
            writer.write(emap, stamp=0.5 * k)
            emap.load_state(emap.state._replace(elevation=emap.state.elevation + 1))
    maps = list(read_grid_maps(tmp_path / name))
    assert [one.stamp for one in maps] == [0.0, 0.5, 1.0]
    rise = maps[2].layers["elevation"] - maps[0].layers["elevation"]
    np.testing.assert_allclose(rise[np.isfinite(rise)], 2, atol=1e-5)
    with Bag(tmp_path / name) as bag:
        first = next(bag.read(["/costs"])).data
    assert first.header.frame_id == "odom" and first.info.width == emap.elevation.shape[1]
    assert set(np.unique(first.data)) <= set(range(-1, 101))


def stored(path, grid_map, topic="/map", orientation=(0.0, 0.0, 0.0, 1.0)):
    """A bag with a GridMap as it is, with any start index and order."""
    from torchelev.io.bags.grid_maps import _to_message

    with BagWriter(path) as bag:
        message = _to_message(bag, grid_map, 0.0, "map")
        for name, value in zip("xyzw", orientation, strict=True):
            setattr(message.info.pose.orientation, name, value)
        bag.write(topic, "grid_map_msgs/msg/GridMap", 0.0, message)


@pytest.mark.slow(1)
@pytest.mark.parametrize("name", ["map.bag", "map.mcap"])
@pytest.mark.parametrize("start", [(0, 0), (3, 5)])
@pytest.mark.parametrize("row_major", [False, True])
def test_any_start_index_and_storage_order(tmp_path, name, start, row_major):
    emap = mapped()
    grid_map = to_grid_map(emap, layers=("elevation",))
    (array,) = grid_map.data
    rows, columns = emap.elevation.shape[1:]
    matrix = np.roll(array.data.reshape(columns, rows).T, start, (0, 1))
    labels = array.layout.dim
    if row_major:
        dims = [labels[1]._replace(size=rows, stride=rows * columns), labels[0]._replace(size=columns, stride=columns)]
        array = array._replace(layout=array.layout._replace(dim=dims), data=matrix.ravel())
    else:
        array = array._replace(data=matrix.ravel(order="F"))
    changed = grid_map._replace(data=[array], outer_start_index=start[0], inner_start_index=start[1])
    stored(tmp_path / name, changed)
    np.testing.assert_array_equal(
        read_grid_map(tmp_path / name).layers["elevation"], emap.layer("elevation")[0].numpy()
    )


def test_a_turned_map_is_read_as_grid_map_does_and_said(tmp_path):
    stored(tmp_path / "map.mcap", to_grid_map(mapped()), orientation=(0.0, 0.0, 0.5**0.5, 0.5**0.5))
    with pytest.warns(UserWarning, match="orientation"):
        read_grid_map(tmp_path / "map.mcap")
    stored(tmp_path / "unset.mcap", to_grid_map(mapped()), orientation=(0.0, 0.0, 0.0, 0.0))
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        read_grid_map(tmp_path / "unset.mcap")


def test_several_topics_have_to_be_named(tmp_path):
    emap, path = mapped(), tmp_path / "maps.mcap"
    from torchelev.io.bags.grid_maps import _to_message

    with BagWriter(path) as bag:
        for topic in ("/a", "/b"):
            bag.write(topic, "grid_map_msgs/msg/GridMap", 0.0, _to_message(bag, to_grid_map(emap), 0.0, topic))
    with pytest.raises(RecordingError, match="there are 2 topics of GridMaps: /a, /b; name one with topic="):
        read_grid_map(path)
    with pytest.raises(RecordingError, match="there is no topic /c of GridMaps; such topics are /a, /b"):
        read_grid_map(path, "/c")
    assert read_grid_map(path, "/b").frame == "/b"


def test_a_bag_without_a_grid_map_is_refused(tmp_path):
    with BagWriter(tmp_path / "other.mcap") as bag:
        bag.write("/p", "geometry_msgs/msg/Point", 0.0, bag.make("geometry_msgs/msg/Point", x=0.0, y=0.0, z=0.0))
    with pytest.raises(RecordingError, match="there are 0 topics of GridMaps: none"):
        read_grid_map(tmp_path / "other.mcap")


@pytest.mark.slow(1)
def test_a_cut_bag_is_refused_or_its_end_is_said(tmp_path):
    emap, path = mapped(), tmp_path / "maps.mcap"
    with GridMapWriter(path, ("elevation",)) as writer:
        for k in range(4):
            writer.write(emap, stamp=float(k))
            writer._bag._bag.storage.close_chunk()
    whole = path.read_bytes()
    read = []
    for part in range(1, 20):
        path.write_bytes(whole[: len(whole) * part // 20])
        with pytest.raises(RecordingError):
            read += [one.stamp for one in read_grid_maps(path)] or [None]
    path.write_bytes(whole[: len(whole) * 3 // 4])
    maps = read_grid_maps(path)
    assert next(maps).stamp == 0.0  # what is there can be read, and then it is said that it was not closed


def test_wrong_layers_write_nothing(tmp_path):
    with pytest.raises(KeyError):
        write_grid_map(tmp_path / "map.mcap", mapped(), layers=("height",))
    with pytest.raises(ValueError, match="path: must be a bag's, got map.png"):
        write_grid_map(tmp_path / "map.png", mapped())
    (tmp_path / "folder").mkdir()
    with pytest.raises(FileExistsError, match="is a folder; choose another name"):
        write_grid_map(tmp_path / "folder", mapped())
    assert [path.name for path in tmp_path.iterdir()] == ["folder"]


def test_inconsistent_sizes_are_refused(tmp_path):
    grid_map = to_grid_map(mapped())
    stored(tmp_path / "map.mcap", grid_map._replace(info=grid_map.info._replace(length_x=grid_map.info.length_x + 1)))
    with pytest.raises(ValueError, match="must have .* rows"):
        read_grid_map(tmp_path / "map.mcap")
