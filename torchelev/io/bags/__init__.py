"""Bags, the recordings of ROS 1 and ROS 2: scans and poses out of them, as a recording that `torchelev map` fuses.

Needs ``torchelev[bags]``; no ROS. `bag` reads messages of `files`; `point_cloud` and `scans` turn them into points by
`messages`; `poses` finds poses; `topics`, `cameras` and `periods` choose the topics and how to read them; `recording`
puts it all together. `grid_maps` writes maps to bags and reads them.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from torchelev.lazy_names import import_later

if TYPE_CHECKING:
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

# Imported when first asked for: clouds of messages are read without PyTorch.
_LATER = {
    "Bag": "torchelev.io.bags.bag",
    "BagRecording": "torchelev.io.bags.recording",
    "BagRequest": "torchelev.io.bags.topics",
    "GridMapWriter": "torchelev.io.bags.grid_maps",
    "Message": "torchelev.io.bags.bag",
    "RecordedMap": "torchelev.io.bags.grid_maps",
    "Topic": "torchelev.io.bags.bag",
    "TransformTree": "torchelev.io.bags.poses.transforms",
    "from_bytes": "torchelev.io.bags.grid_maps",
    "is_bag": "torchelev.io.bags.bag",
    "open_bag": "torchelev.io.bags.recording",
    "read_grid_map": "torchelev.io.bags.grid_maps",
    "read_grid_maps": "torchelev.io.bags.grid_maps",
    "to_bytes": "torchelev.io.bags.grid_maps",
    "write_grid_map": "torchelev.io.bags.grid_maps",
}
__getattr__, __dir__ = import_later(__name__, _LATER)
