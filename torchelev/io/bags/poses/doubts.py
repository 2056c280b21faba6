"""Warnings about poses that are probably wrong: they jump, or the robot does not move as expected."""

from __future__ import annotations

import numpy as np

from torchelev.io.bags.poses.motion import angles, find_jumps, motion
from torchelev.io.bags.poses.names import is_robot
from torchelev.io.bags.poses.rows import to_matrices
from torchelev.io.bags.poses.transforms import TransformTree

_STILL = 0.1  # [m], [rad] of a base that hardly moves
REACH = 3.0  # [m] by which parts of a robot move against each other
_BATCH = 100_000  # poses that are looked at at once


def describe_jumps(tree: TransformTree, frames: list[str], bag_start: float) -> list[str]:
    """Return a sentence for each of the frames whose poses jump, with the options that map one part.

    Args:
        tree: all transforms.
        frames: that move in their parents.
        bag_start: [s] when the bag starts, by the time of recording.
    """
    lines = [_describe_jump(tree, frame, bag_start) for frame in dict.fromkeys(frames)]
    return [line for line in lines if line]


def _describe_jump(tree: TransformTree, frame: str, bag_start: float) -> str:
    rows = tree.rows(frame)
    parts = [rows[k : k + _BATCH] for k in range(0, len(rows), _BATCH)]
    jumps = np.concatenate(
        [k * _BATCH + np.flatnonzero(find_jumps(part[:, 0], to_matrices(part))) for k, part in enumerate(parts)]
    )
    if not len(jumps):
        return ""
    poses = to_matrices(rows[np.concatenate([jumps, jumps + 1])])
    before, after = poses[: len(jumps)], poses[len(jumps) :]
    sizes = np.linalg.norm(after[:, :3, 3] - before[:, :3, 3], axis=1)
    worst = int(sizes.argmax())
    index, turned = int(jumps[worst]), np.degrees(angles(before[worst], after[worst]))
    turn = f" and turns by {turned:.0f} degrees" if turned > 10 else ""
    span, parent = rows[index + 1, 0] - rows[index, 0], tree.parent(frame)
    more = f", and {len(jumps) - 1} times more" if len(jumps) > 1 else ""
    at, since = rows[index + 1, -1], rows[index + 1, 0] - rows[0, 0]
    cure = f"give --end {at - bag_start - 0.001:.3f} or --start {at - bag_start:.3f} to map one part, or other --poses"
    return (
        f"{frame} jumps by {sizes[worst]:.1f} m{turn} in {parent} within {span:.2g} s, {since:.1f} s after its first "
        f"pose (stamp {rows[index + 1, 0]:.3f}){more}: what was mapped before does not fit what comes after"
        + (f"; {cure}" if np.isfinite(at) else "")
    )


def describe_stillness(
    tree: TransformTree, map_frame: str, base_frame: str, sensor: str, others: list[str], is_asked: bool
) -> list[str]:
    """Return a sentence if the base hardly moves in the map's frame, or moves far in another one.

    Args:
        tree: all transforms.
        map_frame: the map's frame.
        base_frame: the base's.
        sensor: frame of a sensor.
        others: frames that could be the map's.
        is_asked: whether both frames were asked for, as those of a robot that stands still are.
    """
    base, seen = motion(tree, map_frame, base_frame), motion(tree, map_frame, sensor)
    far = {other: motion(tree, other, base_frame).travel for other in others if other != map_frame}
    best = max(far, key=lambda other: far[other], default="")
    if best and far[best] > max(3 * base.travel, 3 * _STILL):
        return [
            f"{base_frame} travels {base.travel:.2f} m in {map_frame}, and {far[best]:.1f} m in {best}: the map moves "
            f"with the robot; give --map-frame {best}"
        ]
    if is_asked:
        return []
    if is_robot(map_frame) and base.travel < REACH:
        return [
            f"{map_frame} has the name of a robot's frame: if the robot drives, the map moves with it; give --poses "
            "TOPIC, or --map-frame FRAME"
        ]
    if max(base.travel, seen.travel, base.turn, seen.turn) < _STILL:
        return [
            f"{base_frame} hardly moves in {map_frame}, by {base.travel:.2f} m: if the robot drives, give --poses "
            "TOPIC, or --map-frame FRAME; if it stands still, give "
            f"--map-frame {map_frame} --base-frame {base_frame}"
        ]
    return []
