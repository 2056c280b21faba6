"""When the points of a scan were measured: units and origins of times, and whether they are those of one scan."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from torchelev.io.notes import Note

TIME_FIELDS = ("t", "time", "timestamp", "time_stamp", "offset_time", "time_offset", "ts")
_UNITS = {"s": 1.0, "ms": 1e-3, "us": 1e-6, "ns": 1e-9}
_SHORTEST, _LONGEST = 2e-3, 2.0  # [s] of a scan whose period is unknown
_MARGIN = 1.2  # by which a scan may be longer than the period of its topic
_SLOWEST = 0.21  # [s] period of lidars whose times may be fractions of it: 5 Hz and more
_FEW = 100  # one of so many times may lie apart from all others
_ABSOLUTE = 1e8  # [s] since 1970; larger times are not offsets from the message's stamp


def longest_scan(period: float | None) -> float:
    """Return the longest time [s] that a scan may take, from the period [s] of its topic; None: unknown."""
    return _LONGEST if period is None else min(_LONGEST, _MARGIN * period)


def to_seconds(
    raw: NDArray, stamp: float, period: float | None = None, is_hit: NDArray[np.bool_] | None = None
) -> NDArray[np.float64] | None:
    """Return the times of points from the stamp; None if they are not those of one scan in any unit.

    Args:
        raw: (N,) in s, ms, us or ns, from the stamp or from 1970, or from 0 to 1 as a fraction of the period.
        stamp: [s] of the message.
        period: [s] between two messages; a scan takes no longer. None: unknown.
        is_hit: (N,) whether a point is a return: only their times count. None: all are.

    Returns:
        (N,) [s]; NaN for points that are no return, and for few times that lie apart from all others, as zeros do among
        times since 1970.
    """
    times = _known_times(raw, is_hit)
    finite = times[np.isfinite(times)]
    if not finite.size:
        return None
    units = list(_UNITS.values())
    for unit in reversed(units) if raw.dtype.kind in "iu" else units:
        is_absolute = float(np.median(np.abs(finite))) * unit > _ABSOLUTE
        origin = np.longdouble(stamp) if is_absolute else np.longdouble(0)
        first, last = (float(end * unit - origin) for end in _ends(finite[finite != 0] if is_absolute else finite))
        if _is_scan(first, last, period, is_absolute):
            seconds = (times * unit - origin).astype(np.float64)
            longest = longest_scan(period)
            return np.where((seconds >= last - longest) & (seconds <= first + longest), seconds, np.nan)
    return times.astype(np.float64) * period if period is not None and is_fraction(finite, period) else None


def describe_times(
    name: str, raw: NDArray, times: NDArray | None, stamp: float, period: float | None, is_hit: NDArray[np.bool_]
) -> Note | None:
    """Return a note if a field of times, from which `to_seconds` returned `times`, is implausible; else None."""
    known = _known_times(raw, is_hit)
    finite = known[np.isfinite(known)]
    if times is None:
        if not finite.size or np.ptp(finite) == 0:  # of a camera, or of a driver that does not fill it
            return None
        limit = longest_scan(period)
        text = f"the times in field {name} run from {finite.min():.14g} to {finite.max():.14g}: in no unit is that a"
        text = f"{text} scan of at most {limit:.2g} s at its stamp, {stamp:.14g} s"
        return Note(f"{text}; they are not used", f"times of {name}")
    if period is not None and is_fraction(finite, period) and longest_scan(period) < np.ptp(finite):
        text = f"the times in field {name} run from {round(float(finite.min()))} to {round(float(finite.max()))}"
        return Note(f"{text}: taken as fractions of the period of {period:.3g} s", f"fractions of {name}")
    missing = int((is_hit & ~np.isfinite(times)).sum())
    if missing:
        text = f"{missing} of {is_hit.sum()} points have no time in field {name}, and are left out"
        return Note(text, f"no time of {name}")
    return None


def is_fraction(finite: NDArray, period: float) -> bool:
    """Return whether times run from 0 to 1 or from -1 to 0, of a topic from which hardly any scans were dropped."""
    first, last = float(finite.min()), float(finite.max())
    return period <= _SLOWEST and min(abs(first), abs(first + 1)) <= 0.05 and abs(last - first - 1) <= 0.05


def _ends(times: NDArray[np.longdouble]) -> tuple[np.longdouble, np.longdouble]:
    """Return the first and the last time, without a few outliers."""
    apart = len(times) // _FEW
    ordered = np.partition(times, [apart, len(times) - 1 - apart])
    return ordered[apart], ordered[len(times) - 1 - apart]


def _known_times(raw: NDArray, is_hit: NDArray[np.bool_] | None) -> NDArray[np.longdouble]:
    times = raw.astype(np.longdouble)
    return times if is_hit is None or not is_hit.any() else np.where(is_hit, times, np.nan)


def _is_scan(first: float, last: float, period: float | None, is_absolute: bool) -> bool:
    """Return whether times [s] from the stamp are those of one scan: neither too short, nor too long, nor far away."""
    longest = longest_scan(period)
    away = _LONGEST if is_absolute else 2 * longest  # a stamp of the host's clock may come later than the points
    return _SHORTEST <= last - first <= longest and max(abs(first), abs(last)) <= away + longest
