"""After which scans the growing map is recorded."""

from __future__ import annotations

from torchelev.io import Frame

_ROUNDING = 1e-6  # [s]


class DueScans:
    """Decides which scans are due: the first, and then one every so often.

    Args:
        seconds: [s] of the recording between two of them, at least.
        scans: between two of them, at least.

    Attributes:
        time: [s] of the last scan since the first one.
    """

    def __init__(self, seconds: float, scans: int = 1) -> None:
        self._seconds, self._scans = seconds, scans
        self.time = 0.0
        self._due, self._left = 0.0, 0

    def is_due(self, frame: Frame) -> bool:
        """Return whether a scan is due; called once for each."""
        self.time += frame.dt
        self._left -= 1
        is_due = self.time >= self._due - _ROUNDING and self._left < 0
        if is_due:
            self._due, self._left = self.time + self._seconds, self._scans - 1
        return is_due
