"""Ground that a gate rejects by mistake: a hillside above the exclusion ramp, and vegetation."""

from __future__ import annotations

import numpy as np

from torchelev.diagnosis.evidence import MIN_POINTS, Evidence
from torchelev.diagnosis.scan_fit import find_plane

_MIN_SHARE = 0.05  # of the points, on the hillside and above the ramp
_MAX_SLOPE = 50.0  # [deg] steeper planes are walls
CELL_SIZE, MIN_IN_CELL, SPREAD = 0.1, 4, 0.05  # [m], points, [m]


def find_cut_hillside(seen: Evidence) -> str | None:
    """Find ground that rises above the exclusion ramp: the rejected points continue the plane of the others."""
    shares, angles = [], []
    for k, overhang in enumerate(seen.overhang):
        masks = np.split(overhang, len(seen.points[k]))
        for points, T, cut in zip(seen.points[k], seen.poses[k], masks, strict=True):
            plane = find_plane(points[np.isfinite(points).all(1)]) if cut.sum() >= MIN_POINTS else None
            if plane is None:
                continue
            normal = plane.normal * -np.sign(plane.offset)  # towards the sensor: the plane is below it
            width = 0.05 + 0.02 * np.linalg.norm(points[cut], axis=1)
            on_plane = np.abs(points[cut] @ plane.normal - plane.offset) < width
            shares.append(on_plane.sum() / len(points))
            angles.append(np.degrees(np.arccos(np.clip(T[2, :3] @ normal, -1, 1))))
    if not shares or np.median(shares) < _MIN_SHARE or np.median(angles) > _MAX_SLOPE:
        return None
    angle = float(np.median(angles))
    slope, far = np.tan(np.radians(angle)), max(seen.cfg.grid.length_x, seen.cfg.grid.length_y) / 2
    return (
        f"points: {100 * np.median(shares):.0f} % of the points lie on ground that rises at {angle:.0f} deg, above the "
        f"exclusion ramp: set sensor.exclusion.slope to {slope + 0.1:.1f} and sensor.exclusion.height to "
        f"{slope * far + 0.5:.1f} m"
    )


def is_overgrown(seen: Evidence) -> bool:
    """Return whether points of one scan differ in height within cells, as on vegetation, independent of the poses."""
    spreads = []
    for k in range(len(seen.numbers)):
        points = seen.used_points(k)
        if len(points) >= MIN_POINTS:
            _, cell = np.unique(np.floor(points[:, :2] / CELL_SIZE).astype(np.int64), axis=0, return_inverse=True)
            number = np.bincount(cell.ravel())
            mean = np.bincount(cell.ravel(), points[:, 2]) / number
            square = np.bincount(cell.ravel(), np.square(points[:, 2] - mean[cell.ravel()])) / number
            spreads.append(np.sqrt(square[number >= MIN_IN_CELL]))
    spread = np.concatenate(spreads or [np.zeros(0)])
    return len(spread) >= MIN_POINTS and float(np.median(spread)) > SPREAD
