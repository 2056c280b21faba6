"""The recordings, split into what is mapped and what is held out."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray

from torchelev.io import Frame, Recording, open_recording, read_poses
from torchelev.stages.measure.config import ExclusionConfig
from torchelev.stages.measure.stage import above_ramp

_ROBOT_RADIUS = 0.6  # [m] around the lidar of `offroad`, within which it sees the robot itself


@dataclass(frozen=True)
class Case:
    """A recording to map and the points to compare the map with."""

    name: str
    recording: Recording
    held_out: NDArray  #: (N, 3) [m], map frame
    resolution: float  #: [m] of the map
    driven: NDArray | None = None  #: (T, 3) [m] positions of the lidar on the driven path, inside the window


class _OneScan(Recording):
    """A recording of one scan that is already read."""

    def __init__(self, frame: Frame) -> None:
        super().__init__([Path(frame.name)], frame.T_map_sensor[None], np.zeros(1), lambda path: frame.points)


def read_cases(root: Path, seed: int) -> list[Case]:
    """Read the recordings under `root` and hold out the second scan, or a tenth of the points drawn by `seed`."""
    car = open_recording(root / "parked_car")
    field = open_recording(root / "offroad")[0]
    chosen = np.random.default_rng(seed).random(len(field.points)) < 0.1
    mapped = _OneScan(field._replace(points=field.points[~chosen]))
    driven = _interpolate(read_poses(root / "offroad" / "driven_path.txt").T_map_sensor[:, :3, 3], step=0.02)
    driven = driven[np.linalg.norm((driven - field.T_map_sensor[:3, 3])[:, :2], axis=1) > _ROBOT_RADIUS]
    second, tenth = below_ramp(car[1]), below_ramp(field._replace(points=field.points[chosen]))
    return [
        Case("parked_car", car[:1], second, 0.2),
        Case("parked_car", car[:1], second, 0.1),
        Case("offroad", mapped, tenth, 0.1, driven),
    ]


def _interpolate(path: NDArray, step: float) -> NDArray:
    """Return points every `step` [m] on the straight lines between the positions (T, 3) [m] of a path."""
    distance = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(path, axis=0), axis=1))])
    at = np.arange(0.0, distance[-1], step)
    return np.stack([np.interp(at, distance, path[:, axis]) for axis in range(3)], axis=-1)


def in_map(frame: Frame) -> NDArray:
    """Return the points of a frame (N, 3) [m] in the map frame."""
    return frame.points @ frame.T_map_sensor[:3, :3].T + frame.T_map_sensor[:3, 3]


def below_ramp(frame: Frame) -> NDArray:
    """Return the points of a frame (N, 3) [m] in the map frame, without those above the exclusion ramp."""
    points = in_map(frame)
    relative = torch.from_numpy(points - frame.T_map_sensor[:3, 3])
    return points[~above_ramp(relative, ExclusionConfig()).numpy()]
