"""Choose the frame of the map and that of the robot's base."""

from __future__ import annotations

from torchelev.io.bags.bag import Bag
from torchelev.io.bags.topics import BagRequest
from torchelev.io.bags.transforms import TransformTree
from torchelev.io.errors import RecordingError

_BASES = ("base_link", "base_footprint", "base", "trunk", "body")


def choose_frames(bag: Bag, tree: TransformTree, sensor: str, request: BagRequest) -> tuple[str, str]:
    """Return the map's and the base's frame: the requested ones, or those between which the robot moves."""
    given = [frame for frame in (request.map_frame, request.base_frame, sensor) if frame is not None]
    missing = next((frame for frame in given if frame not in tree.frames), None)
    if missing is not None:
        have = ", ".join(tree.frames) or "none"
        hint = "choose one of them" if tree.frames else "give --poses TOPIC if the bag holds Odometry"
        raise RecordingError(bag.path, f"the transforms have no frame {missing}; frames are {have}", hint)
    chain = tree.ancestors(sensor)
    moving = [frame for frame in chain[:-1] if not tree.is_static(frame)]
    if request.base_frame is None and not moving:
        raise RecordingError(bag.path, f"no transform moves {sensor}; above it are {', '.join(chain[1:]) or 'none'}",
                             "give --poses TOPIC, or --map-frame and --base-frame of a still robot")  # fmt: skip
    named = [frame for frame in moving if frame.rsplit("/", 1)[-1] in _BASES]
    base = request.base_frame or (named or moving)[0]
    above = tree.ancestors(base)
    if request.map_frame is None and len(above) < 2:
        raise RecordingError(bag.path, f"there is no frame above {base}", "give --map-frame")
    return request.map_frame or _moving_parent(tree, above), base


def _moving_parent(tree: TransformTree, above: list[str]) -> str:
    """Return the first frame in which the base moves: above it, odometry comes before localisation."""
    for child, parent in zip(above, above[1:], strict=False):
        if not tree.is_static(child):
            return parent
    return above[-1]
