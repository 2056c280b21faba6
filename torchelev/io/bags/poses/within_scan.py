"""Take the sensor's motion within a scan out of its points."""

from __future__ import annotations

import numpy as np
import torch
from numpy.typing import NDArray

from torchelev.frames import deskew
from torchelev.io.bags.poses.transforms import TransformTree
from torchelev.io.bags.scans import Scan

_POSE_STEP, _MAX_POSES = 0.01, 64  # [s] between the poses of a scan, and how many there are at most


def hold_still(tree: TransformTree, map_frame: str, scan: Scan) -> NDArray[np.float32] | None:
    """Return the points (N, 3) [m] as seen from the sensor's place at the stamp; None: there are too few poses."""
    if scan.times is None:
        return scan.points
    finite = scan.times[np.isfinite(scan.times)]
    first, last = min(float(finite.min()), 0.0), max(float(finite.max()), 0.0)
    num = int(np.clip(np.ceil((last - first) / _POSE_STEP) + 1, 2, _MAX_POSES))
    times = np.linspace(first, last, num)
    poses = tree.look_up(map_frame, scan.frame, scan.stamp + times)
    known = np.isfinite(poses).all((1, 2))
    if known.sum() < 2:
        return None
    given = scan.points, scan.times, poses[known], times[known]
    points, at, T, stamps = (torch.from_numpy(np.ascontiguousarray(value))[None] for value in given)
    return deskew(points, at, T, stamps, torch.zeros(1), tree.max_extrapolation)[0].numpy()
