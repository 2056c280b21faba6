"""Requests to a bag, and the topics that answer them."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from typing import Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray

from torchelev.io.bags.bag import Bag, Topic
from torchelev.io.bags.messages.packets import converter_of
from torchelev.io.bags.scans import CLOUDS, IMAGES
from torchelev.io.errors import RecordingError


class BagRequest(NamedTuple):
    """What to read from a bag; None and () are found in the bag."""

    clouds: Sequence[str] = ()  #: topics of clouds or laser scans
    depths: Sequence[str] = ()  #: topics of depth images
    map_frame: str | None = None  #: in which the map is built
    base_frame: str | None = None  #: which the window follows
    poses: str | None = None  #: topic of Odometry or PoseStamped in place of the transforms
    transforms: Sequence[str] = ()  #: topics of TFMessage, if not /tf and /tf_static or those of the scans' namespace
    T_base_sensor: NDArray[np.float64] | None = None  #: (4, 4) where the sensor is on the base, in place of transforms
    rays_from: str | None = None  #: frame at which the rays start of clouds that are in the map's frame; None: the base
    clock_offsets: Mapping[str, float] = {}  #: [s] to add to the stamps of a topic's scans; "": of all others
    stamps: Literal["header", "recorded"] = "header"  #: which time of a message counts, its stamp or its recording
    start: float | None = None  #: [s] after the bag's start, by the time of recording; None: its start
    end: float | None = None  #: [s] as `start`; None: its end
    camera_infos: Sequence[str] = ()  #: topics of CameraInfo, one for all of `depths` or one for each
    depth_scale: float | None = None  #: metres per unit of depth; None: the bag's, or that of the images' encoding
    depth_axes: str = "optical"  #: axes of the frame of depth images, see `depth_to_points`
    odometry: Literal["kiss-icp"] | None = None  #: finds poses from the first topic's clouds; None: they are known
    imu: str | None = None  #: topic of Imu by which the map's z axis points up, with `odometry`; None: by the ground
    colors: bool = False  #: read the colours of the clouds' points
    semantic: str | None = None  #: topic of images of class labels
    semantic_info: str | None = None  #: topic of its CameraInfo; None: the one beside it
    classes: Sequence[str] = ()  #: names of the labels 0, 1, ...; (): as many as there are


def depth_topics(topics: Iterable[Topic]) -> list[str]:
    """Return the names of topics of images whose names say that these are depth images."""
    return [topic.name for topic in topics if topic.type in IMAGES and "depth" in topic.name]


def find_depth(types: dict[str, Topic], request: BagRequest) -> BagRequest:
    """Return the request, for the only topic of depth images where a bag has no clouds and none was named."""
    depths = depth_topics(types.values())
    has_clouds = any(topic.type in CLOUDS for topic in types.values())
    if request.clouds or request.depths or has_clouds or len(depths) != 1:
        return request
    return request._replace(depths=depths)


def choose_topics(bag: Bag, types: dict[str, Topic], request: BagRequest) -> list[str]:
    """Return the requested topics, or the only one of clouds."""
    for names, kinds, option in ((request.clouds, CLOUDS, "--points"), (request.depths, IMAGES, "--depth")):
        for name in names:
            kind = types[name].type if name in types else absence(bag, name)
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
    raise RecordingError(bag.path, f"there is no topic of clouds; topics are {name_topics(bag.topics)}", _hint(bag))


def _hint(bag: Bag) -> str:
    """Return how a bag without a topic of clouds can be mapped."""
    packets = [(topic, converter) for topic in (*bag.topics, *bag.unread) if (converter := converter_of(topic.type))]
    if packets:
        (topic, converter), *_ = packets
        return f"{topic.name} holds a lidar's packets, {topic.type}: replay it through {converter}, record PointCloud2"
    if bag.unread:
        return f"not read: {describe_unread(bag)}; give --depth for depth images"
    return "give --depth for depth images"


def describe_unread(bag: Bag) -> str:
    """Return the topics of a bag that cannot be read, with the type, number and reason of each, in one line."""
    return "; ".join(f"{topic.name} ({topic.num:,} of {topic.type}: {topic.problem})" for topic in bag.unread)


def absence(bag: Bag, name: str) -> str:
    """Return why a topic is not among those that can be read: it is not there, or of a type that is not known."""
    unread = next((topic for topic in bag.unread if topic.name == name), None)
    return "not in the bag" if unread is None else f"{unread.type}, not read: {unread.problem}"


def name_topics(topics: list[Topic]) -> str:
    """Return the names of topics in one line."""
    return ", ".join(topic.name for topic in topics) or "none"
