"""`torchelev map --video`: film the growing map."""

from __future__ import annotations

import math
from array import array
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from torchelev.app.interrupts import defer_interrupts
from torchelev.app.mapping.recording_schedule import RecordingSchedule
from torchelev.errors import require
from torchelev.io import Frame, MappingRun

if TYPE_CHECKING:
    from torchelev.viz.map_frames import MapFrames
    from torchelev.viz.video import VideoWriter

_FPS, _MAX_FRAMES = 10, 600  # a minute at most, unless --every says otherwise
_SIDES = {".mp4": 720, ".gif": 480}  # [pixels] of the map: a GIF compresses badly


class MapVideo:
    """Draws a frame after some of the scans, and one of the last map. Use it in a `with` statement.

    Args:
        path: of the video, `.mp4` or `.gif`; None: nothing is drawn.
        every: [s] of the recording between two frames; None: so many scans that there are at most 600 frames.
        num_scans: of the recording.
        title: above the map.

    Raises:
        ValueError: the path is not a video's.
        WriteError: the path cannot be written.
        ModuleNotFoundError: PyAV is missing.
    """

    def __init__(self, path: Path | None, every: float | None, num_scans: int, title: str) -> None:
        self.path, self.title = path, title
        self._writer: VideoWriter | None = None
        self._frames: MapFrames | None = None
        self._path_xy = array("d")
        self._not_drawn: MappingRun | None = None  # the map of the last scan, unless it was drawn
        self._schedule = RecordingSchedule(every or 0.0, math.ceil(num_scans / _MAX_FRAMES) if every is None else 1)
        if path is not None:
            is_known = path.suffix.lower() in _SIDES
            require(is_known, "--video", "must end in .mp4 or .gif", path.name, "give another name")
            from torchelev.viz.map_frames import MapFrames
            from torchelev.viz.video import VideoWriter

            self._writer = VideoWriter(path, _FPS, MapFrames.colors())

    @property
    def num(self) -> int:
        """The number of frames so far."""
        return 0 if self._writer is None else self._writer.num

    def __enter__(self) -> MapVideo:
        return self

    def __exit__(self, kind: type[BaseException] | None, *exception: object) -> None:
        if self._writer is None:
            return
        with defer_interrupts():
            try:
                if self._not_drawn is not None:
                    self._draw(self._writer, self._not_drawn)
            finally:
                self._writer.close()

    def after(self, run: MappingRun, frame: Frame) -> None:
        """Draw a frame if it is due; called after each scan."""
        if self._writer is None:
            return
        T = frame.T_map_sensor if frame.T_map_base is None else frame.T_map_base
        self._path_xy.extend(T[:2, 3].tolist())
        self._not_drawn = run
        if self._schedule.is_due(frame):
            self._draw(self._writer, run)

    def _draw(self, writer: VideoWriter, run: MappingRun) -> None:
        values = run.emap.layer("elevation")[0].cpu().numpy()
        if self._frames is None:
            self._frames = self._new_frames(values.shape, run.emap.cfg.grid.resolution)
        center, path_xy = run.emap.center[0, :2].cpu().numpy(), np.array(self._path_xy).reshape(-1, 2)
        caption = f"{self._schedule.time:.1f} s, {run.num_scans:,} scans"
        self._not_drawn = None  # even if writing fails, which it would do again
        writer.add(self._frames.draw(values, center, path_xy, caption))

    def _new_frames(self, shape: tuple[int, int], resolution: float) -> MapFrames:
        from torchelev.viz.map_frames import MapFrames

        assert self.path is not None
        return MapFrames(shape, resolution, self.title, _SIDES[self.path.suffix.lower()])
