"""Bags, the recordings of ROS 1 and ROS 2: scans and poses out of them, as a recording that `torchelev map` fuses.

Needs ``torchelev[bags]``; no ROS. `bag` reads messages of `files`; `point_cloud` and `scans` turn them into points by
`messages`; `poses` finds poses; `topics`, `cameras` and `periods` choose the topics and how to read them; `recording`
puts it all together. `grid_maps` writes maps to bags and reads them.
"""

from torchelev.io.bags.bag import Bag, Message, Topic, is_bag
from torchelev.io.bags.grid_maps import (
    GridMapWriter,
    RecordedMap,
    from_bytes,
    read_grid_map,
    read_grid_maps,
    to_bytes,
    write_grid_map,
)
from torchelev.io.bags.poses.transforms import TransformTree
from torchelev.io.bags.recording import BagRecording, open_bag
from torchelev.io.bags.topics import BagRequest

__all__ = [
    "Bag",
    "BagRecording",
    "BagRequest",
    "GridMapWriter",
    "Message",
    "RecordedMap",
    "Topic",
    "TransformTree",
    "from_bytes",
    "is_bag",
    "open_bag",
    "read_grid_map",
    "read_grid_maps",
    "to_bytes",
    "write_grid_map",
]
