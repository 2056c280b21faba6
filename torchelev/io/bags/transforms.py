"""The tree of transforms between frames, as tf2 keeps it, for a whole recording at once."""

from __future__ import annotations

from array import array
from typing import Any, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray

from torchelev.frames import interpolate_poses, transform_xyzw
from torchelev.io.bags.scans import clean, stamp_of


class FrameError(LookupError):
    """There is no way between two frames. The message says which frames exist and where the tree is broken."""


class _Edge(NamedTuple):
    """The poses of a frame in its parent, as rows of 8 numbers: stamp [s], x, y, z [m], quaternion x, y, z, w."""

    parent: str
    is_static: bool
    rows: array[float]


class TransformTree:
    """The transforms of a recording. Frames are nodes, each with one parent.

    Args:
        max_extrapolation: [s] by which a time may lie outside of a transform's stamps.
    """

    def __init__(self, max_extrapolation: float = 0.1) -> None:
        self.max_extrapolation = max_extrapolation
        self._edges: dict[str, _Edge] = {}
        self._sorted: dict[str, NDArray] = {}
        self._parents: dict[str, list[str]] = {}  # of each frame, in order of arrival
        self._requested: set[str] = set()  # frames whose transforms are replaced by a topic of poses

    @property
    def frames(self) -> list[str]:
        """All frames, by name."""
        return sorted({*self._edges, *(edge.parent for edge in self._edges.values())})

    def add(self, parent: str, child: str, stamp: float, pose: Any, is_static: bool = False) -> None:
        """Add the pose of a frame in its parent at a time [s]: position x, y, z [m], quaternion x, y, z, w.

        A new parent replaces the old one. A pose that is not finite, or whose quaternion is none, is left out.
        """
        parent, child, row = clean(parent), clean(child), (stamp, *pose)
        if not (np.isfinite(row).all() and sum(q * q for q in row[4:]) > 0.5):
            return
        parents = self._parents.setdefault(child, [])
        if parent not in parents:
            parents.append(parent)
        edge = self._edges.get(child)
        if edge is None or edge.parent != parent or edge.is_static != is_static or is_static:
            edge = self._edges[child] = _Edge(parent, is_static, array("d"))
        edge.rows.extend(row)
        self._sorted.pop(child, None)

    def add_message(self, message: Any, is_static: bool) -> None:
        """Add the transforms of a tf2_msgs/TFMessage."""
        for stamped in message.transforms:
            if clean(stamped.child_frame_id) in self._requested:
                continue
            pose = _numbers(stamped.transform.translation, stamped.transform.rotation)
            self.add(stamped.header.frame_id, stamped.child_frame_id, stamp_of(stamped.header), pose, is_static)

    def add_odometry(self, message: Any) -> None:
        """Add the pose of a nav_msgs/Odometry, in place of that frame's transforms."""
        self._replace(message.child_frame_id)
        pose = _numbers(message.pose.pose.position, message.pose.pose.orientation)
        self.add(message.header.frame_id, message.child_frame_id, stamp_of(message.header), pose)

    def add_pose(self, message: Any, child: str) -> None:
        """Add a geometry_msgs/PoseStamped, the pose of a frame that the message does not name, as Odometry."""
        self._replace(child)
        pose = _numbers(message.pose.position, message.pose.orientation)
        self.add(message.header.frame_id, child, stamp_of(message.header), pose)

    def _replace(self, frame: str) -> None:
        """Drop the transforms of a frame, also those to come."""
        frame = clean(frame)
        if frame not in self._requested:
            self._requested.add(frame)
            for kept in (self._edges, self._parents, self._sorted):
                kept.pop(frame, None)

    def describe_conflicts(self) -> list[str]:
        """Return a sentence for each frame that has several parents."""
        return [
            f"{frame} has several parents in the transforms, {' and '.join(parents)}: only its last poses in "
            f"{self._edges[frame].parent} are used; give --poses, or record one parent"
            for frame, parents in sorted(self._parents.items())
            if len(parents) > 1
        ]

    def describe_gaps(self, target: str, source: str, max_gap: float) -> list[str]:
        """Return a sentence for each transform between two frames that pauses for longer than a time [s]."""
        lines = []
        for frame in self._moving_between(target, source):
            stamps = self._rows(frame)[:, 0]
            gaps = np.diff(stamps)
            if not (gaps > max_gap).any():
                continue
            longest, more = int(gaps.argmax()), int((gaps > max_gap).sum()) - 1
            lines.append(
                f"{frame} has no pose in {self._edges[frame].parent} for {gaps[longest]:.1f} s, from "
                f"{stamps[longest] - stamps[0]:.1f} s after its first (stamp {stamps[longest]:.3f})"
                + (f", and {more} more" if more else "")
                + ": scans there have interpolated poses"
            )
        return lines

    def ancestors(self, frame: str) -> list[str]:
        """Return a frame, its parent, its parent's parent, ... up to the root."""
        chain = [frame]
        while chain[-1] in self._edges and self._edges[chain[-1]].parent not in chain:
            chain.append(self._edges[chain[-1]].parent)
        return chain

    def is_static(self, frame: str) -> bool:
        """Tell whether a frame never moves in its parent."""
        return self._edges[frame].is_static

    def look_up(self, target: str, source: str, times: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return T_target_source at times (M,) [s], (M, 4, 4); NaN where a transform is not known then.

        Raises:
            FrameError: there is no way between the frames.
        """
        up, down = self.ancestors(source), self.ancestors(target)
        common = next((frame for frame in up if frame in down), None)
        if common is None:
            raise FrameError(self._explain(target, source))
        to_common = self._chain(up[: up.index(common)], times)
        return invert(self._chain(down[: down.index(common)], times)) @ to_common

    def stamps(self, target: str, source: str) -> NDArray[np.float64]:
        """Return the times [s] of all poses that move between two frames; of none, that there is no motion: [0]."""
        frames = self._moving_between(target, source)
        return np.concatenate([self._rows(frame)[:, 0] for frame in frames]) if frames else np.zeros(1)

    def _moving_between(self, target: str, source: str) -> list[str]:
        """Return the frames that move in their parent, on the way between two frames."""
        up, down = self.ancestors(source), self.ancestors(target)
        way = [frame for frame in up if frame not in down] + [frame for frame in down if frame not in up]
        return [frame for frame in way if frame in self._edges and not self.is_static(frame)]

    def _chain(self, frames: list[str], times: NDArray) -> NDArray:
        """Return the pose of the first frame in the parent of the last one."""
        pose = np.tile(np.eye(4), (len(times), 1, 1))
        for frame in frames:
            pose = self._pose_at(frame, times) @ pose
        return pose

    def _pose_at(self, frame: str, times: NDArray) -> NDArray:
        rows = self._rows(frame)
        if self._edges[frame].is_static:
            return np.tile(_matrices(rows[-1:]), (len(times), 1, 1))
        first, last = np.searchsorted(rows[:, 0], [times.min(), times.max()])
        first, last = min(max(first - 1, 0), max(len(rows) - 2, 0)), max(last + 1, 2)
        rows = rows[first:last]
        if len(rows) == 1:
            near = np.abs(times - rows[0, 0]) <= self.max_extrapolation
            return np.where(near[:, None, None], _matrices(rows), np.nan)
        start = rows[0, 0]  # float64 keeps nanoseconds only near 0
        arrays = _matrices(rows)[None], (rows[:, 0] - start)[None], (times - start)[None]
        poses, stamps, asked = (torch.from_numpy(array) for array in arrays)
        return interpolate_poses(poses, stamps, asked, self.max_extrapolation)[0].numpy()

    def _rows(self, frame: str) -> NDArray[np.float64]:
        """Return the poses of a frame as rows (K, 8), by their stamps, each stamp once."""
        if frame not in self._sorted:
            rows = np.array(self._edges[frame].rows).reshape(-1, 8)
            self._sorted[frame] = rows if len(rows) == 1 else rows[np.unique(rows[:, 0], return_index=True)[1]]
        return self._sorted[frame]

    def _explain(self, target: str, source: str) -> str:
        known = ", ".join(self.frames) or "none"
        for frame in (target, source):
            if frame not in self.frames:
                return f"there is no frame {frame}; frames are {known}"
        tops = self.ancestors(target)[-1], self.ancestors(source)[-1]
        return (
            f"no transform connects {target} and {source}: {target} hangs below {tops[0]}, {source} below {tops[1]}, "
            f"and nothing says where {tops[1]} is in {tops[0]}; frames are {known}"
        )

    def draw(self) -> list[str]:
        """Return the tree as lines of text, children below their parents."""
        roots = [frame for frame in self.frames if frame not in self._edges]
        lines: list[str] = []
        for root in roots:
            lines.append(root)
            self._draw_below(root, "", lines)
        return lines

    def _draw_below(self, parent: str, indent: str, lines: list[str]) -> None:
        children = [frame for frame in self.frames if frame in self._edges and self._edges[frame].parent == parent]
        for child in children:
            is_last = child == children[-1]
            edge = self._edges[child]
            kind = "static" if edge.is_static else f"{len(edge.rows) // 8:,} poses"
            lines.append(f"{indent}{'└─' if is_last else '├─'} {child} ({kind})")
            self._draw_below(child, indent + ("   " if is_last else "│  "), lines)


def invert(T: NDArray[np.float64]) -> NDArray[np.float64]:
    """Invert rigid transforms (..., 4, 4)."""
    inverse = np.zeros_like(T)
    rotation = np.swapaxes(T[..., :3, :3], -1, -2)
    inverse[..., :3, :3], inverse[..., 3, 3] = rotation, T[..., 3, 3]
    inverse[..., :3, 3] = -(rotation @ T[..., :3, 3, None])[..., 0]
    return inverse


def _numbers(position: Any, orientation: Any) -> list[float]:
    place, turn = [getattr(position, name) for name in "xyz"], [getattr(orientation, name) for name in "xyzw"]
    return [float(value) for value in (*place, *turn)]


def _matrices(rows: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the poses (K, 4, 4) of rows (K, 8)."""
    quaternions = rows[:, 4:] / np.linalg.norm(rows[:, 4:], axis=1, keepdims=True)
    return transform_xyzw(rows[:, 1:4], quaternions).numpy()
