"""Maps in bags: grid_map_msgs/GridMap and nav_msgs/OccupancyGrid written, GridMap read."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from torchelev.io.bags.bag import Bag
from torchelev.io.bags.files.definitions import GRID_MAP, make_typestore
from torchelev.io.bags.scans import stamp_of
from torchelev.io.bags.writing import BagWriter
from torchelev.io.errors import RecordingError
from torchelev.io.grid_map import GridMap, from_grid_map, to_grid_map
from torchelev.io.occupancy import to_occupancy_grid

if TYPE_CHECKING:
    from torchelev.elevation_map import ElevationMap

_OCCUPANCY = "nav_msgs/msg/OccupancyGrid"


class RecordedMap(NamedTuple):
    """A GridMap in torchelev's convention."""

    layers: dict[str, NDArray[np.float32]]  #: name -> (H, W): i grows with +x, j with +y; NaN where unknown
    resolution: float  #: [m]
    center: NDArray[np.float64]  #: (3,) [m], in the frame
    frame: str  #: in which the map is
    stamp: float  #: [s] at which it was made


class GridMapWriter:
    """Writes maps to a bag, to be replayed in RViz or Foxglove. Use it in a `with` statement.

    Args:
        path: `.bag` for ROS 1; `.mcap` or `.db3` for a file of ROS 2; without suffix for a folder of ROS 2. The bag
            appears there when the writer is closed.
        layers: names as in `ElevationMap.layer`; None: all of them, and packed colours.
        topic: of the GridMaps.
        frame: of the maps.
        occupancy_topic: of OccupancyGrids from the traversability, see `to_occupancy_grid`; None: none are written.

    Raises:
        ValueError: the path is not a bag's.
        FileExistsError: there is a folder of this name.
        ModuleNotFoundError: rosbags is missing.
    """

    def __init__(
        self,
        path: str | Path,
        layers: Sequence[str] | None = None,
        topic: str = "/elevation_map",
        frame: str = "map",
        occupancy_topic: str | None = None,
    ) -> None:
        self.layers, self.topic, self.frame, self.occupancy_topic = layers, topic, frame, occupancy_topic
        self._bag = BagWriter(path)

    def __enter__(self) -> GridMapWriter:
        return self

    def __exit__(self, *exception: object) -> None:
        self.close()

    def close(self) -> None:
        """Finish the bag; what was written is kept."""
        self._bag.close()

    def write(self, emap: ElevationMap, stamp: float = 0.0, env: int = 0) -> None:
        """Append a map.

        Args:
            emap: the map.
            stamp: [s] at which it was made.
            env: the environment.

        Raises:
            KeyError: a layer does not exist.
            ValueError: the environment does not exist.
        """
        layers = _all_layers(emap) if self.layers is None else self.layers
        message = _to_message(self._bag, to_grid_map(emap, env, layers, ("elevation",)), stamp, self.frame)
        self._bag.write(self.topic, GRID_MAP, stamp, message)
        if self.occupancy_topic is not None:
            grid = _to_occupancy_message(self._bag, emap, env, stamp, self.frame)
            self._bag.write(self.occupancy_topic, _OCCUPANCY, stamp, grid)


def _all_layers(emap: ElevationMap) -> tuple[str, ...]:
    """Return all layers, and the channels of colours, which RViz reads packed."""
    return (*emap.layers, *(name for name, cfg in emap.cfg.channels.items() if cfg.is_color))


def write_grid_map(
    path: str | Path,
    emap: ElevationMap,
    env: int = 0,
    layers: Sequence[str] | None = None,
    *,
    topic: str = "/elevation_map",
    frame: str = "map",
    stamp: float = 0.0,
    occupancy_topic: str | None = None,
) -> None:
    """Write one map as grid_map_msgs/GridMap to a new bag.

    Args:
        path: see `GridMapWriter`.
        emap: the map.
        env: the environment.
        layers: names as in `ElevationMap.layer`; None: all of them, and packed colours.
        topic: of the GridMap.
        frame: of the map.
        stamp: [s] at which it was made.
        occupancy_topic: of an OccupancyGrid from the traversability; None: none is written.

    Raises:
        KeyError: a layer does not exist. Nothing is written then.
        ValueError: the environment does not exist, or the path is not a bag's.
        FileExistsError: there is a folder of this name.
        ModuleNotFoundError: rosbags is missing.
    """
    to_grid_map(emap, env, _all_layers(emap) if layers is None else layers)  # raises before there is a file
    with GridMapWriter(path, layers, topic, frame, occupancy_topic) as writer:
        writer.write(emap, stamp, env)


def read_grid_map(path: str | Path, topic: str | None = None) -> RecordedMap:
    """Read the last grid_map_msgs/GridMap of a bag, of ROS 1 or ROS 2.

    Args:
        path: of the bag.
        topic: of the GridMaps; None: the only one there is.

    Returns:
        The layers in torchelev's convention, with resolution, centre, frame and stamp.

    Raises:
        RecordingError: the bag cannot be read, or holds no GridMap or several topics of them.
        ValueError: the sizes or the storage order of the GridMap are inconsistent.
    """
    last = None
    for last in read_grid_maps(path, topic):  # noqa: B007
        pass
    if last is None:
        raise RecordingError(path, "the topic holds no message", "choose another topic")
    return last


def read_grid_maps(path: str | Path, topic: str | None = None) -> Iterator[RecordedMap]:
    """Read all GridMaps of a topic in the order of their recording; see `read_grid_map`."""
    with Bag(path) as bag:
        topics = [found.name for found in bag.topics if found.type == GRID_MAP]
        have = ", ".join(topics) or "none"
        if topic is not None and topic not in topics:
            raise RecordingError(path, f"there is no topic {topic} of GridMaps", f"such topics are {have}")
        if topic is None and len(topics) != 1:
            unread = "".join(f"; {one.name} of {one.type} is not read: {one.problem}" for one in bag.unread)
            raise RecordingError(
                path, f"there are {len(topics)} topics of GridMaps: {have}{unread}", "name one with topic="
            )
        for message in bag.read([topic or topics[0]]):
            yield from_message(message.data)
        if bag.ended_early:
            raise RecordingError(path, bag.ended_early)


def from_message(message: Any) -> RecordedMap:
    """Read a received grid_map_msgs/GridMap of ROS 1 or ROS 2, with frame and stamp."""
    header = message.header if hasattr(message, "header") else message.info.header
    layers, center, resolution = from_grid_map(message)
    return RecordedMap(layers, resolution, center, header.frame_id, stamp_of(header))


def to_bytes(grid_map: GridMap, stamp: float = 0.0, frame: str = "map", ros: int = 2) -> bytes:
    """Serialise a GridMap as a message of ROS 1, or of ROS 2 (CDR).

    Args:
        grid_map: what `to_grid_map` returned.
        stamp: [s] of the header.
        frame: of the header.
        ros: 1 or 2.
    """
    types = _Types(ros)
    return types.serialize(_to_message(types, grid_map, stamp, frame), GRID_MAP)


def from_bytes(data: bytes, ros: int = 2) -> RecordedMap:
    """Read a serialised grid_map_msgs/GridMap; arguments as of `to_bytes`."""
    store = make_typestore(ros)
    deserialize = store.deserialize_ros1 if ros == 1 else store.deserialize_cdr
    return from_message(deserialize(data, GRID_MAP))


class _Types(BagWriter):
    """Makes and serialises messages without a bag."""

    def __init__(self, ros: int) -> None:
        self.ros, self.store = ros, make_typestore(ros)


def _to_message(bag: BagWriter, grid_map: GridMap, stamp: float, frame: str) -> Any:
    """Return the message of a GridMap, in the types of a bag."""
    header, info = bag.make_header(stamp, frame), grid_map.info
    make = bag.make
    pose = make(
        "geometry_msgs/msg/Pose",
        position=make("geometry_msgs/msg/Point", **info.pose.position._asdict()),
        orientation=make("geometry_msgs/msg/Quaternion", **info.pose.orientation._asdict()),
    )
    sizes = dict(resolution=info.resolution, length_x=info.length_x, length_y=info.length_y, pose=pose)
    upper, lower = ({}, {"header": header}) if bag.ros == 1 else ({"header": header}, {})
    data = []
    for array in grid_map.data:
        dim = [make("std_msgs/msg/MultiArrayDimension", **one._asdict()) for one in array.layout.dim]
        layout = make("std_msgs/msg/MultiArrayLayout", dim=dim, data_offset=array.layout.data_offset)
        data.append(make("std_msgs/msg/Float32MultiArray", layout=layout, data=array.data))
    rest = dict(layers=grid_map.layers, basic_layers=grid_map.basic_layers, data=data)
    start = dict(outer_start_index=grid_map.outer_start_index, inner_start_index=grid_map.inner_start_index)
    return make(GRID_MAP, **upper, info=make("grid_map_msgs/msg/GridMapInfo", **lower, **sizes), **rest, **start)


def _to_occupancy_message(bag: BagWriter, emap: ElevationMap, env: int, stamp: float, frame: str) -> Any:
    grid = to_occupancy_grid(emap, env)
    make, header = bag.make, bag.make_header(stamp, frame)
    pose = make(
        "geometry_msgs/msg/Pose",
        position=make("geometry_msgs/msg/Point", **grid.info.origin.position._asdict()),
        orientation=make("geometry_msgs/msg/Quaternion", **grid.info.origin.orientation._asdict()),
    )
    sizes = dict(resolution=np.float32(grid.info.resolution), width=grid.info.width, height=grid.info.height)
    info = make("nav_msgs/msg/MapMetaData", map_load_time=header.stamp, **sizes, origin=pose)
    return make(_OCCUPANCY, header=header, info=info, data=grid.data)
