"""`torchelev map --grid-map`: record the growing map as GridMap messages."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

from torchelev.io import Frame, MappingRun

if TYPE_CHECKING:
    from torchelev.io import GridMapWriter

_ROUNDING = 1e-6  # [s]


class MapRecorder:
    """Writes the map to a bag every so often, in the time of the recording. Use it in a `with` statement.

    Args:
        path: of the bag; None: nothing is written.
        every: [s] between two maps; 0: one for each scan.
        frame: of the map.

    Raises:
        ValueError: the path is no bag's.
        FileExistsError: there is a folder of this name.
        ModuleNotFoundError: rosbags is missing.
    """

    def __init__(self, path: Path | None, every: float, frame: str) -> None:
        self._writer: GridMapWriter | None = None
        self.path, self.every, self.num = path, every, 0
        self._time = 0.0  # [s] since the first scan
        self._due = 0.0
        if path is not None:
            from torchelev.io.bags import GridMapWriter

            self._writer = GridMapWriter(path, frame=frame)

    def __enter__(self) -> MapRecorder:
        return self

    def __exit__(self, *exception: object) -> None:
        if self._writer is not None:
            self._writer.close()

    def after(self, run: MappingRun, frame: Frame) -> None:
        """Write the map if it is due; called after each scan."""
        if self._writer is None:
            return
        self._time += frame.dt
        if self._time >= self._due - _ROUNDING:
            self._writer.write(run.emap, frame.stamp or self._time)
            self._due, self.num = self._time + self.every, self.num + 1
