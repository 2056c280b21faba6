"""`torchelev map --grid-map`: record the growing map as GridMap messages."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

from torchelev.app.interrupts import defer_interrupts
from torchelev.app.mapping.recording_schedule import RecordingSchedule
from torchelev.io import Frame, MappingRun

if TYPE_CHECKING:
    from torchelev.io import GridMapWriter


class MapRecorder:
    """Writes the map to a bag every so often, in the time of the recording. Use it in a `with` statement.

    Args:
        path: of the bag; None: nothing is written.
        every: [s] between two maps; 0: one for each scan.
        frame: of the map.

    Raises:
        ValueError: the path is not a bag's.
        FileExistsError: there is a folder of this name.
        ModuleNotFoundError: rosbags is missing.
    """

    def __init__(self, path: Path | None, every: float, frame: str) -> None:
        self._writer: GridMapWriter | None = None
        self.path, self.num = path, 0
        self._schedule = RecordingSchedule(every)
        if path is not None:
            from torchelev.io.bags import GridMapWriter

            self._writer = GridMapWriter(path, frame=frame)

    def __enter__(self) -> MapRecorder:
        return self

    def __exit__(self, *exception: object) -> None:
        if self._writer is not None:
            with defer_interrupts():
                self._writer.close()

    def after(self, run: MappingRun, frame: Frame) -> None:
        """Write the map if it is due; called after each scan."""
        if self._schedule.is_due(frame) and self._writer is not None:
            self._writer.write(run.emap, frame.stamp or self._schedule.time)
            self.num += 1
