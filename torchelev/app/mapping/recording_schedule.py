"""Decides after which scans the growing map is recorded."""

from __future__ import annotations

from torchelev.io import Frame

_ROUNDING = 1e-6  # [s]


class RecordingSchedule:
    """Decides after which scans a map is recorded: the first, and then at most one per interval.

    Args:
        seconds: shortest interval, in the time of the recording [s].
        scans: shortest interval, as a number of scans.

    Attributes:
        time: [s] from the first scan to the last.
    """

    def __init__(self, seconds: float, scans: int = 1) -> None:
        self._seconds, self._scans = seconds, scans
        self.time = 0.0
        self._next, self._left = 0.0, 0

    def is_due(self, frame: Frame) -> bool:
        """Return whether the map is to be recorded after a scan; call it once for each scan."""
        self.time += frame.dt
        self._left -= 1
        is_due = self.time >= self._next - _ROUNDING and self._left < 0
        if is_due:
            self._next, self._left = self.time + self._seconds, self._scans - 1
        return is_due
