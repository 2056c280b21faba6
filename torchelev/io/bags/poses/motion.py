"""How one frame moves in another over a recording."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from torchelev.io.bags.poses.transforms import TransformTree

_SAMPLES = 2000  # poses that are looked at
_STEP, _ACCELERATION = 0.2, 20.0  # [m], [m/s^2] by which a step may differ from the steps beside it
_TURN, _SPIN = 0.35, 100.0  # [rad], [rad/s^2]
_USUAL = 3.0  # times the steps that 95 % do not exceed


class Motion(NamedTuple):
    """How far a frame travels in another."""

    travel: float  #: [m] diagonal of the box around its places; jumps do not count
    turn: float  #: [rad] largest angle to its first pose


def motion(tree: TransformTree, target: str, source: str) -> Motion:
    """Return how far a frame moves in another one; 0 where no transforms connect them."""
    common = set(tree.ancestors(target)) & set(tree.ancestors(source))
    stamps = np.unique(tree.stamps(target, source)) if common else np.zeros(0)
    stamps = stamps[np.unique(np.linspace(0, len(stamps) - 1, _SAMPLES).astype(int))] if len(stamps) else stamps
    poses = tree.look_up(target, source, stamps) if len(stamps) else np.zeros((0, 4, 4))
    poses, stamps = poses[known := np.isfinite(poses).all((1, 2))], stamps[known]
    if len(poses) < 2:
        return Motion(0.0, 0.0)
    steps = np.diff(poses[:, :3, 3], axis=0)
    steps[find_jumps(stamps, poses)] = 0.0
    travel = float(np.linalg.norm(np.ptp(np.vstack([np.zeros(3), np.cumsum(steps, axis=0)]), axis=0)))
    return Motion(travel, float(angles(poses[:1], poses).max()))


def find_jumps(stamps: NDArray[np.float64], poses: NDArray[np.float64]) -> NDArray[np.bool_]:
    """Return which steps between poses (K, 4, 4) at times (K,) [s] are jumps, not motion, (K - 1,).

    A step is compared with those before and after it: it may differ from the nearer one by what a strong acceleration
    does in its time, and by three times what is usual in this recording.
    """
    spans = np.maximum(np.diff(stamps), 1e-6)
    steps = np.diff(poses[:, :3, 3], axis=0)
    turns = angles(poses[:-1], poses[1:])
    return _exceeds(steps, spans, _STEP, _ACCELERATION) | _exceeds(turns[:, None], spans, _TURN, _SPIN)


def _exceeds(steps: NDArray, spans: NDArray, tolerance: float, acceleration: float) -> NDArray[np.bool_]:
    """Return which of the steps (K, D) differ from both neighbours, and from none, by more than is plausible."""
    if len(steps) < 3:
        return np.zeros(len(steps), dtype=bool)
    rates = steps / spans[:, None]
    before, after = np.vstack([rates[1:2], rates[:-1]]), np.vstack([rates[1:], rates[-2:-1]])
    sizes = np.linalg.norm(steps, axis=1)
    odd = [np.linalg.norm(steps - near * spans[:, None], axis=1) for near in (before, after)]
    limit = np.maximum(tolerance + acceleration / 2 * spans**2, _USUAL * np.quantile(sizes, 0.95))
    return np.minimum(np.minimum(*odd), sizes) > limit


def angles(a: NDArray[np.float64], b: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the angles [rad] between the rotations of poses (..., 4, 4)."""
    cosine = (np.sum(a[..., :3, :3] * b[..., :3, :3], axis=(-2, -1)) - 1) / 2
    return np.arccos(np.clip(cosine, -1, 1))
