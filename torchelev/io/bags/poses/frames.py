"""Choose the frame of the map and that of the robot's base: the frames between which the robot travels.

A map's frame is one in which the base travels farthest; of several, the one nearest to the base, so
that odometry comes before localisation, which jumps. Frames of the robot, such as a footprint that moves below a body,
are none. Names decide where motion does not: of a robot that stands still, or between frames that move alike.
"""

from __future__ import annotations

from pathlib import Path
from typing import NamedTuple

from torchelev.io.bags.poses.doubts import REACH, describe_stillness
from torchelev.io.bags.poses.motion import motion
from torchelev.io.bags.poses.names import is_base, is_robot, is_world
from torchelev.io.bags.poses.transforms import TransformTree
from torchelev.io.bags.topics import BagRequest
from torchelev.io.errors import RecordingError

_CLEAR = 0.3  # [m] of travel beyond the sway of a body
_BRANCH = 1.0  # [m] that a base travels in a frame below it, such as odometry upside down; legs and wheels are nearer
_HINT = (
    "give --poses TOPIC, or --map-frame and --base-frame, as of a still robot; --rays-from FRAME if the clouds are in "
    "the map's frame; --odometry kiss-icp to find poses from the clouds of a lidar"
)


class Frames(NamedTuple):
    """The frames of a recording."""

    map: str  #: in which the map is built
    base: str  #: that the window follows
    notes: list[str]  #: notes on doubtful frames


def choose_frames(path: Path, tree: TransformTree, sensor: str, request: BagRequest) -> Frames:
    """Return the map's and the base's frame: the requested ones, or those between which the robot moves.

    Args:
        path: of the bag, for errors.
        tree: all transforms.
        sensor: frame of the first scan.
        request: frames that were asked for.

    Raises:
        RecordingError: a frame is missing, or nothing moves.
    """
    fixed = is_fixed(tree, sensor, request)
    base = request.base_frame or (
        _find_traveller(tree, sensor) if fixed else _find_base(tree, sensor, request.map_frame)
    )
    chosen = request.map_frame or (sensor if fixed else _choose_above(tree, base))
    if chosen is None or (not request.map_frame and is_robot(chosen)):
        below = _choose_below(tree, sensor)
        if below is not None:
            chosen, base = below, request.base_frame or _base_above(tree, sensor)
    if chosen is None:
        raise RecordingError(path, f"no transform moves {sensor}; {_describe(tree, sensor)}", _HINT)
    is_asked = bool(request.map_frame and request.base_frame)
    others = _candidates(tree, base)
    doubts = describe_stillness(tree, chosen, base, sensor, others, is_asked)
    return Frames(chosen, base, doubts or ([] if request.map_frame else _name_others(tree, chosen, base)))


def _find_base(tree: TransformTree, sensor: str, map_frame: str | None) -> str:
    """Return the frame of the robot's base above a sensor: one with its name, or the one that travels."""
    chain = tree.ancestors(sensor)
    chain = chain[: chain.index(map_frame) + 1] if map_frame in chain else chain
    named = [frame for frame in chain[:-1] if is_base(frame) and not tree.is_static(frame)]
    moving = [frame for frame in _moving(tree, chain[:-1]) if not is_world(frame)]
    return named[0] if named else _farthest(tree, moving) or chain[-1]


def is_fixed(tree: TransformTree, sensor: str, request: BagRequest) -> bool:
    """Return whether a cloud's frame is the map's, as that of clouds which odometry has registered.

    A camera_init or odom below which something moves is; a frame without such a name if a robot's frame travels in it.
    """
    moving, asked = _moving(tree, _below(tree, sensor)), request.map_frame
    if request.rays_from or asked == sensor:
        return bool(moving)
    if not moving or (asked and not set(tree.ancestors(asked)) & set(tree.ancestors(sensor))):
        return False
    if asked and not all(tree.is_constant(frame) for frame in tree.way(asked, sensor)):
        return False
    far = {frame: motion(tree, sensor, frame).travel for frame in moving}
    if is_world(sensor):
        return any(is_base(frame) or far[frame] >= _BRANCH for frame in moving)
    is_top = not _moving(tree, tree.ancestors(sensor)[:-1]) and not is_robot(sensor)
    return is_top and any(is_robot(frame) and far[frame] >= REACH for frame in moving)


def find_robot(tree: TransformTree) -> str | None:
    """Return the robot's base among all transforms, without regard to a sensor; None if no frame moves."""
    frames = [frame for frame in tree.frames if tree.parent(frame) is not None]
    moving = [frame for frame in _moving(tree, frames) if not is_world(frame)]
    named = [frame for frame in frames if is_base(frame) and not tree.is_static(frame)]
    return named[0] if named else _farthest(tree, moving)


def _find_traveller(tree: TransformTree, fixed: str) -> str:
    """Return the base below a fixed frame."""
    moving = [frame for frame in _moving(tree, _below(tree, fixed)) if not is_world(frame)]
    named = [frame for frame in _below(tree, fixed) if is_base(frame) and not tree.is_static(frame)]
    return named[-1] if named else _farthest(tree, moving[::-1]) or fixed


def _farthest(tree: TransformTree, frames: list[str]) -> str | None:
    """Return the frame that travels farthest in its parent; of those that stay, the last one, next to the root."""
    far = {frame: motion(tree, str(tree.parent(frame)), frame).travel for frame in frames}
    if not far or max(far.values()) < _CLEAR:
        return frames[-1] if frames else None
    return max(far, key=lambda frame: far[frame])


def _moving(tree: TransformTree, frames: list[str]) -> list[str]:
    """Return the frames that move in their parents or, if none does, those that could."""
    could = [frame for frame in frames if tree.parent(frame) is not None and not tree.is_static(frame)]
    return [frame for frame in could if not tree.is_constant(frame)] or could


def _below(tree: TransformTree, frame: str) -> list[str]:
    """Return all frames below one, parents first."""
    found = [frame]
    for parent in found:
        found += [child for child in tree.children(parent) if child not in found]
    return found[1:]


def _choose_above(tree: TransformTree, base: str) -> str | None:
    """Return the frame above the base in which it travels; None if there are only still frames of the robot."""
    candidates = _candidates(tree, base)
    far = {frame: motion(tree, frame, base).travel for frame in candidates}
    if not far:
        return None
    if max(far.values()) >= _CLEAR:
        return next(frame for frame in candidates if far[frame] >= max(far.values()) / 2)
    named = [frame for frame in candidates if is_world(frame)]
    return named[0] if named else None if is_robot(candidates[-1]) else candidates[-1]


def _candidates(tree: TransformTree, base: str) -> list[str]:
    """Return the frames above the base with moving descendants; frames of the robot only if there are no others."""
    above = tree.ancestors(base)
    found = [_fixed_alike(tree, str(tree.parent(frame))) for frame in _moving(tree, above[:-1])]
    return [frame for frame in found if not is_robot(frame)] or found


def _fixed_alike(tree: TransformTree, frame: str) -> str:
    """Return a frame, or instead of one of the robot a fixed frame above it that never moves against it."""
    for other in tree.ancestors(frame) if is_robot(frame) else []:
        if is_world(other):
            return other
        if tree.parent(other) is not None and not tree.is_constant(other):
            break
    return frame


def _choose_below(tree: TransformTree, sensor: str) -> str | None:
    """Return the frame below the robot in which it travels: odometry that is published inverted."""
    root = tree.ancestors(sensor)[-1]
    frames = [frame for frame in _below(tree, root) if not is_robot(frame)]
    far = {frame: motion(tree, frame, root).travel for frame in frames}
    named = [frame for frame in frames if is_world(frame) and tree.moving_between(frame, root)]
    found = named or [frame for frame in frames if far[frame] >= _BRANCH and frame not in tree.ancestors(sensor)]
    return next((frame for frame in found if far[frame] >= max(far[one] for one in found) / 2), None)


def _base_above(tree: TransformTree, sensor: str) -> str:
    """Return the base above a sensor whose root is a frame of the robot."""
    chain = tree.ancestors(sensor)
    return next((frame for frame in chain if is_base(frame)), chain[-1])


def _describe(tree: TransformTree, sensor: str) -> str:
    """Describe the frames above a sensor without a moving base, and the frames that move."""
    above = ", ".join(tree.ancestors(sensor)[1:]) or "none"
    moving = [f"{frame} in {tree.parent(frame)}" for frame in _moving(tree, _below(tree, tree.ancestors(sensor)[-1]))]
    return f"above it are {above}" + (f", and what moves is {', '.join(moving)}" if moving else "")


def _name_others(tree: TransformTree, chosen: str, base: str) -> list[str]:
    """Return a sentence if the base travels in another frame too, and that moves against the chosen one."""
    travel = motion(tree, chosen, base).travel
    limit = max(_CLEAR, travel / 10)
    for other in _candidates(tree, base):
        if is_world(chosen) and is_world(other):
            continue
        far = motion(tree, other, base).travel
        if other != chosen and far >= limit and motion(tree, chosen, other).travel >= limit:
            return [
                f"two frames could be the map's: {base} travels {travel:.1f} m in {chosen}, which was taken, and "
                f"{far:.1f} m in {other}; choose with --map-frame {chosen} or --map-frame {other}"
            ]
    return []
