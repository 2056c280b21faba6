"""What is asked of a bag, and the topics in which that is found."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray

from torchelev.io.bags.bag import Bag, Topic
from torchelev.io.bags.scans import CLOUDS, IMAGES
from torchelev.io.errors import RecordingError

CAMERA = "sensor_msgs/msg/CameraInfo"


class BagRequest(NamedTuple):
    """What to read from a bag; None and () are found in the bag."""

    clouds: Sequence[str] = ()  #: topics of clouds or laser scans
    depths: Sequence[str] = ()  #: topics of depth images
    map_frame: str | None = None  #: in which the map is built
    base_frame: str | None = None  #: which the window follows
    poses: str | None = None  #: topic of Odometry or PoseStamped in place of the transforms
    transforms: Sequence[str] = ()  #: topics of TFMessage; (): /tf and /tf_static, or those of the scans' namespace
    T_base_sensor: NDArray[np.float64] | None = None  #: (4, 4) where the sensor is on the base, in place of transforms
    rays_from: str | None = None  #: frame at which the rays start of clouds that are in the map's frame; None: the base
    clock_offsets: Mapping[str, float] = {}  #: [s] to add to the stamps of a topic's scans; "": of all others
    stamps: Literal["header", "recorded"] = "header"  #: times of messages: their stamps, or when they were recorded
    start: float | None = None  #: [s] after the bag's start, by the time of recording; None: its start
    end: float | None = None  #: [s] as `start`; None: its end
    odometry: Literal["kiss-icp"] | None = None  #: finds poses from the first topic's clouds; None: they are known
    imu: str | None = None  #: topic of Imu by which the map's z axis points up, with `odometry`; None: by the ground


def choose_topics(bag: Bag, types: dict[str, Topic], request: BagRequest) -> list[str]:
    """Return the requested topics, or the only one of clouds."""
    for names, kinds, option in ((request.clouds, CLOUDS, "--points"), (request.depths, IMAGES, "--depth")):
        for name in names:
            kind = types[name].type if name in types else "not in the bag"
            if kind not in kinds:
                have = name_topics([topic for topic in types.values() if topic.type in kinds])
                raise RecordingError(bag.path, f"{option} {name} is {kind}", f"such topics are {have}")
    chosen = [*request.clouds, *request.depths]
    if chosen:
        return chosen
    for kind in CLOUDS:
        found = [topic for topic in types.values() if topic.type == kind]
        if len(found) == 1:
            return [found[0].name]
        if found:
            raise RecordingError(
                bag.path, f"there are {len(found)} topics of clouds: {name_topics(found)}", "give --points"
            )
    have = name_topics(list(types.values()))
    raise RecordingError(bag.path, f"there is no topic of clouds; topics are {have}", "give --depth for depth images")


def name_topics(topics: list[Topic]) -> str:
    """Return the names of topics in one line."""
    return ", ".join(topic.name for topic in topics) or "none"


def find_cameras(bag: Bag, types: dict[str, Topic], depths: Sequence[str]) -> dict[str, Any]:
    """Return the CameraInfo of each topic of depth images: the one beside it."""
    cameras = {}
    for depth in depths:
        # compressedDepth adds a level: /camera/depth/image_rect_raw/compressedDepth
        folders = [depth.rsplit("/", level)[0] for level in (1, 2)]
        info = next((f"{folder}/camera_info" for folder in folders if f"{folder}/camera_info" in types), None)
        if info is None:
            have = name_topics([topic for topic in types.values() if topic.type == CAMERA])
            raise RecordingError(bag.path, f"{depth} has no camera_info beside it", f"topics of CameraInfo are {have}")
        message = next(bag.read([info]), None)
        if message is None:
            raise RecordingError(bag.path, f"{info} holds no message", "record it with the images")
        cameras[depth] = message.data
    return cameras
