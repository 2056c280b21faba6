"""Messages of one topic as points: clouds with their motion taken out, and depth images. No ROS."""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass, field
from functools import cached_property
from statistics import median
from typing import Any

import numpy as np
from numpy.typing import NDArray

from torchelev.io.bags.messages.cloud import CloudError
from torchelev.io.bags.messages.depth_image import CameraSettings
from torchelev.io.bags.poses.within_scan import Poses, find_span, move_to_stamp
from torchelev.io.bags.scans import Scan, read_scan

_FEW, _MANY = 4, 16  # stamps from which a period is known, and from how many


@dataclass
class Sensor:
    """A topic of clouds or of depth images."""

    topic: str  #: of the messages
    is_depth: bool = False  #: they are depth images
    scale: float | None = None  #: [m] per unit of depth; None: that of the encoding
    camera: Any = None  #: the newest CameraInfo of depth images
    _stamps: deque[float] = field(default_factory=lambda: deque(maxlen=_MANY))

    def note(self, stamp: float) -> None:
        """Note the stamp [s] of a message that arrived."""
        if self._stamps and stamp < self._stamps[-1]:
            self._stamps.clear()
        self._stamps.append(stamp)

    @property
    def lacks_camera(self) -> bool:
        """Whether a CameraInfo is missing without which depth images are no points."""
        return self.is_depth and self.camera is None

    @property
    def period(self) -> float | None:
        """Time between two messages [s]; None: not known yet."""
        if len(self._stamps) < _FEW:
            return None
        return median(np.diff(self._stamps)) or None

    def read(self, message: Any) -> Scan:
        """Return the points of a message; CloudError if it contradicts itself, or has no CameraInfo yet."""
        if not self.is_depth:
            return read_scan(message, period=self.period)
        if self.lacks_camera:
            raise CloudError("no CameraInfo was received; see the parameter camera_infos")
        return read_scan(message, CameraSettings(self.camera, self.topic, self.scale))


@dataclass
class Reading:
    """A message that is read when its points are needed, once."""

    sensor: Sensor  #: where it comes from
    message: Any  #: the message

    @cached_property
    def cloud(self) -> Scan:
        """Its points; CloudError as `Sensor.read`."""
        return self.sensor.read(self.message)

    @cached_property
    def _span(self) -> tuple[float, float]:
        try:
            return find_span(self.cloud)
        except CloudError:  # said when it is fused
            return 0.0, 0.0

    def find_span(self, deskew: bool) -> tuple[float, float]:
        """Return the first and the last time [s] from the stamp at which poses are needed; 0, 0 if it is not read."""
        return self._span if deskew else (0.0, 0.0)

    def points(self, deskew: bool, poses: Poses) -> NDArray[np.float32]:
        """Return the points (N, 3) [m] as seen from the sensor's place at the stamp.

        Args:
            deskew: take the motion within the scan out.
            poses: returns T_map_sensor (M, 4, 4) at times (M,) [s] from the stamp, NaN where it is not known.

        Raises:
            CloudError: as `Sensor.read`, or there are too few poses within the scan.
        """
        if not deskew or self.cloud.times is None:
            return self.cloud.points
        moved = move_to_stamp(self.cloud, poses)
        if moved is None:
            first, last = self._span
            times = f"from {first:.3g} to {last:.3g} s from its stamp"
            raise CloudError(
                f"tf has too few poses {times} to take out the motion within the scan; or set deskew false"
            )
        return moved
