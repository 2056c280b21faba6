"""Sensors that see the same ground at different heights: those of one update, or those that take turns."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from torchelev.diagnosis.evidence import Evidence
from torchelev.diagnosis.scan_fit import MIN_CELLS, average_cells

MIN_BIAS = 0.01  # [m]
MAX_SENSORS = 6  # that take turns
MIN_TURNS = 5  # of all sensors, that a period must rest on
MIN_EXPLAINED = 0.8  # of the corrections' variance; noise of the poses leaves less than half of it to a period
_CURE = "calibrate the heights at which they are mounted"


def find_sensor_bias(seen: Evidence) -> str | None:
    """Find sensors of one update whose heights differ in the cells that they share, in all updates alike."""
    if seen.is_in_millimetres or seen.far_cloud or seen.explained[1]:
        return None
    found = [(abs(bias), s, bias) for s in range(1, len(seen.points[0])) if (bias := _bias_of(seen, s)) is not None]
    if not found:
        return None
    _, sensor, bias = max(found)
    side = "above" if bias > 0 else "below"
    return (
        f"sensors: sensor {sensor} sees the ground {100 * abs(bias):.1f} cm {side} sensor 0; "
        f"{_CURE}, as the map takes heights between them"
    )


def _bias_of(seen: Evidence, sensor: int) -> float | None:
    """Return by how much a sensor sees the ground above the first one [m]; None where this is noise."""
    differences = []
    for k in range(len(seen.numbers)):
        a, b = _cells_of(seen, k, 0), _cells_of(seen, k, sensor)
        both = a.keys() & b.keys()
        if len(both) >= MIN_CELLS:
            differences.append(float(np.median([b[key] - a[key] for key in both])))
    if not differences:
        return None
    mean = float(np.mean(differences))
    return mean if abs(mean) >= max(MIN_BIAS, 2 * float(np.std(differences))) else None


def _cells_of(seen: Evidence, k: int, sensor: int) -> dict[tuple[int, int], float]:
    """Return the mean height [m] of each cell in which a sensor's points have nearly the same."""
    used = np.split(seen.used[k], len(seen.points[k]))[sensor]
    T = seen.poses[k][sensor]
    return average_cells(seen.points[k][sensor][used] @ T[:3, :3].T + T[:3, 3])


def find_alternating_corrections(seen: Evidence) -> str | None:
    """Find drift corrections that repeat: each sensor, or each phase of a gait, has its own height offset."""
    corrections = np.array(seen.corrections)
    for period in range(2, MAX_SENSORS + 1):
        recent = corrections[-(len(corrections) // period) * period :]
        if len(recent) < MIN_TURNS * period:
            return None
        heights = _repeated_heights(recent.reshape(-1, period))
        if heights is not None and np.ptp(heights) >= MIN_BIAS:
            return (
                f"sensors or poses: drift compensation moves the map by {100 * np.ptp(heights):.1f} cm and back, every "
                f"{period} updates: sensors take turns and disagree in height, or poses lag behind a robot that sways; "
                f"{_CURE}, or take poses at the scans' time stamps"
            )
    return None


def _repeated_heights(corrections: NDArray) -> NDArray | None:
    """Return the height [m] of each of a period's updates, from corrections (turns, period); None if none repeats."""
    corrections = corrections - corrections.mean()  # a common offset, such as steady drift, is not a disagreement
    mean = corrections.mean(0)
    total, left = np.square(corrections).sum(), np.square(corrections - mean).sum()
    return np.cumsum(mean) if left < (1 - MIN_EXPLAINED) * total else None
