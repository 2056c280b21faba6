"""The tree of transforms between frames, as tf2 keeps it, for a whole recording at once."""

from __future__ import annotations

from array import array
from collections.abc import Iterable
from typing import Any, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray

from torchelev.frames import interpolate_poses
from torchelev.io.bags.poses.rows import WIDTH, describe_gap, invert, is_constant, to_matrices
from torchelev.io.bags.scans import clean


class FrameError(LookupError):
    """No transforms connect two frames. The message says which frames exist and where the tree is broken."""


class _Edge(NamedTuple):
    """The poses of a frame in its parent, see `rows`."""

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
        self._constant: dict[str, bool] = {}
        self._parents: dict[str, list[str]] = {}  # of each frame, in order of arrival
        self._requested: set[str] = set()  # frames whose transforms are replaced by a topic of poses
        self._held: set[str] = set()  # frames whose last pose holds at all times

    @property
    def frames(self) -> list[str]:
        """All frames, by name."""
        return sorted({*self._edges, *(edge.parent for edge in self._edges.values())})

    def add(
        self, parent: str, child: str, stamp: float, pose: Any, is_static: bool = False, recorded: float = np.nan
    ) -> None:
        """Add the pose of a frame in its parent at a time [s]: position x, y, z [m], quaternion x, y, z, w.

        A new parent replaces the old one. A pose that is not finite, or whose quaternion is invalid, is left out.
        Static poses are left out where others are known; `recorded` is when it was recorded [s].
        """
        parent, child, row = clean(parent), clean(child), (stamp, *pose)
        if not (np.isfinite(row).all() and sum(q * q for q in row[4:]) > 0.5):
            return
        parents = self._parents.setdefault(child, [])
        if parent not in parents:
            parents.append(parent)
        edge = self._edges.get(child)
        if edge is not None and edge.parent == parent and is_static and not edge.is_static:
            return
        if edge is None or edge.parent != parent or edge.is_static != is_static or is_static:
            edge = self._edges[child] = _Edge(parent, is_static, array("d"))
        edge.rows.extend((*row, recorded))
        self._forget(child)

    def replace(self, frame: str) -> None:
        """Drop the transforms of a frame, also those to come."""
        frame = clean(frame)
        if frame not in self._requested:
            self._requested.add(frame)
            for kept in (self._edges, self._parents):
                kept.pop(frame, None)
            self._forget(frame)

    def is_replaced(self, frame: str) -> bool:
        """Return whether the transforms of a frame are dropped."""
        return clean(frame) in self._requested

    def drop_circles(self) -> None:
        """Drop the transforms of a parent in its own child: odometry that is published both ways."""
        for frame in self._requested & self._edges.keys():
            parent = self._edges[frame].parent
            if parent in self._edges and self._edges[parent].parent == frame:
                del self._edges[parent]
                self._forget(parent)

    def keep_recorded(self, start: float, end: float) -> None:
        """Keep the poses that were recorded between two times [s], and the static ones."""
        for frame, edge in list(self._edges.items()):
            if edge.is_static:
                continue
            rows = np.array(edge.rows).reshape(-1, WIDTH)
            kept = rows[~((rows[:, -1] < start) | (rows[:, -1] > end))]
            if len(kept) == len(rows):
                continue
            self._forget(frame)
            self._edges[frame] = edge._replace(rows=array("d", kept.ravel()))
            if not len(kept):
                del self._edges[frame]

    def hold(self, frames: Iterable[str]) -> None:
        """Let the last pose of some frames hold at all times."""
        self._held.update(frames)

    def _forget(self, frame: str) -> None:
        self._sorted.pop(frame, None)
        self._constant.pop(frame, None)

    def parent(self, frame: str) -> str | None:
        """Return the parent of a frame; None if it has none."""
        return self._edges[frame].parent if frame in self._edges else None

    def children(self, frame: str) -> list[str]:
        """Return the frames whose parent a frame is, by name."""
        return sorted(child for child, edge in self._edges.items() if edge.parent == frame)

    def ancestors(self, frame: str) -> list[str]:
        """Return a frame, its parent, its parent's parent, ... up to the root."""
        chain = [frame]
        while chain[-1] in self._edges and self._edges[chain[-1]].parent not in chain:
            chain.append(self._edges[chain[-1]].parent)
        return chain

    def is_static(self, frame: str) -> bool:
        """Return whether a frame never moves in its parent: by its topic, or because it is held."""
        return self._edges[frame].is_static or frame in self._held

    def is_constant(self, frame: str) -> bool:
        """Return whether all poses of a frame in its parent are the same, whatever their topic."""
        if frame not in self._constant:
            edge = self._edges[frame]
            self._constant[frame] = edge.is_static or is_constant(self.recorded_rows(frame))
        return self._constant[frame]

    def look_up(self, target: str, source: str, times: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return T_target_source at times (M,) [s], (M, 4, 4); NaN where a transform is not known then.

        Raises:
            FrameError: no transforms connect the frames.
        """
        up, down = self.ancestors(source), self.ancestors(target)
        common = next((frame for frame in up if frame in down), None)
        if common is None:
            raise FrameError(self.explain(target, source))
        to_common = self._chain(up[: up.index(common)], times)
        return invert(self._chain(down[: down.index(common)], times)) @ to_common

    def way(self, target: str, source: str) -> list[str]:
        """Return the frames whose poses in their parents lie on the way between two frames."""
        up, down = self.ancestors(source), self.ancestors(target)
        both = [frame for frame in up if frame not in down] + [frame for frame in down if frame not in up]
        return [frame for frame in both if frame in self._edges]

    def moving_between(self, target: str, source: str) -> list[str]:
        """Return the frames that move in their parent, on the way between two frames."""
        return [frame for frame in self.way(target, source) if not self.is_static(frame)]

    def stamps(self, target: str, source: str) -> NDArray[np.float64]:
        """Return the times [s] of all moving poses between two frames; [0] if none moves."""
        frames = self.moving_between(target, source)
        return np.concatenate([self.rows(frame)[:, 0] for frame in frames]) if frames else np.zeros(1)

    def rows(self, frame: str) -> NDArray[np.float64]:
        """Return the poses of a frame as rows (K, 9), by their stamps, each stamp once."""
        if frame not in self._sorted:
            rows = self.recorded_rows(frame)
            self._sorted[frame] = rows[np.unique(rows[:, 0], return_index=True)[1]]
        return self._sorted[frame]

    def recorded_rows(self, frame: str) -> NDArray[np.float64]:
        """Return the poses of a frame as rows (K, 9), in the order in which they were recorded."""
        return np.frombuffer(self._edges[frame].rows).reshape(-1, WIDTH)  # no copy: hours of poses are large

    def _chain(self, frames: list[str], times: NDArray) -> NDArray:
        """Return the pose of the first frame in the parent of the last one."""
        pose = np.tile(np.eye(4), (len(times), 1, 1))
        for frame in frames:
            pose = self._pose_at(frame, times) @ pose
        return pose

    def _pose_at(self, frame: str, times: NDArray) -> NDArray:
        rows = self.rows(frame)
        if self.is_static(frame):
            return np.tile(to_matrices(rows[-1:]), (len(times), 1, 1))
        first, last = np.searchsorted(rows[:, 0], [times.min(), times.max()])
        first, last = min(max(first - 1, 0), max(len(rows) - 2, 0)), max(last + 1, 2)
        rows = rows[first:last]
        if len(rows) == 1:
            near = np.abs(times - rows[0, 0]) <= self.max_extrapolation
            return np.where(near[:, None, None], to_matrices(rows), np.nan)
        start = rows[0, 0]  # float64 keeps nanoseconds only near 0
        arrays = to_matrices(rows)[None], (rows[:, 0] - start)[None], (times - start)[None]
        poses, stamps, asked = (torch.from_numpy(array) for array in arrays)
        return interpolate_poses(poses, stamps, asked, self.max_extrapolation)[0].numpy()

    def describe_conflicts(self) -> list[str]:
        """Return a sentence for each frame that has several parents."""
        return [
            f"{frame} has several parents in the transforms, {' and '.join(parents)}: only its last poses in "
            f"{self._edges[frame].parent} are used; give --poses, or record one parent"
            for frame, parents in sorted(self._parents.items())
            if len(parents) > 1 and frame in self._edges
        ]

    def describe_gaps(self, target: str, source: str, max_gap: float) -> list[str]:
        """Return a sentence for each transform between two frames that pauses for longer than a time [s]."""
        moving = self.moving_between(target, source)
        lines = [describe_gap(frame, self._edges[frame].parent, self.rows(frame)[:, 0], max_gap) for frame in moving]
        return [line for line in lines if line]

    def explain(self, target: str, source: str) -> str:
        """Return why no transforms connect two frames."""
        known = ", ".join(self.frames) or "none"
        for frame in (target, source):
            if frame not in self.frames:
                return f"there is no frame {frame}; frames are {known}"
        tops = self.ancestors(target)[-1], self.ancestors(source)[-1]
        return (
            f"no transform connects {target} and {source}: {target} is in the tree of {tops[0]}, {source} in that of "
            f"{tops[1]}, and nothing places {tops[1]} in {tops[0]}; frames are {known}"
        )
