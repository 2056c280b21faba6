"""Usual mistakes with a map's inputs and settings, each on the walk that shows it best."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import torch
from scipy.spatial.transform import Rotation
from torch import Tensor

from docs.mistakes.walk import Scan, map_of, scans_of
from torchelev import ElevationMap, ElevationMapConfig, GridConfig, OverlapConfig, SensorConfig
from torchelev.frames import change_axes, transform
from torchelev.sim import mount

GRID = GridConfig(resolution=0.05, length_x=7.0, length_y=7.0)
CFG = ElevationMapConfig(grid=GRID)


Mistake = Callable[[list[Scan]], list[Scan]]


@dataclass(frozen=True)
class Case:
    """A mistake, and the walk and the settings under which it is made."""

    mistake: Mistake  #: turns the right scans into the wrong ones
    scene: str = "mixed"  #: name of a function of `torchelev.sim.exact.scenes`
    pitch_deg: float = 25.0  #: [deg] how far the camera looks down
    given: Mistake = list  #: changes the right scans, too
    right: ElevationMapConfig = CFG  #: settings of the map beside
    wrong: ElevationMapConfig = CFG  #: settings of the map with the mistake
    drawn_wrong: bool = False  #: whether the map is right, and its picture wrong


def right_map(case: Case) -> ElevationMap:
    """Return the map without the mistake."""
    return map_of(case.given(scans_of(case.scene, case.pitch_deg)), case.right)


def wrong_map(case: Case) -> ElevationMap:
    """Return the map with the mistake."""
    return map_of(case.mistake(case.given(scans_of(case.scene, case.pitch_deg))), case.wrong)


def each(**changes: Callable[[Scan], Any]) -> Mistake:
    """Return the mistake that replaces fields of every scan."""
    return lambda scans: [scan._replace(**{name: f(scan) for name, f in changes.items()}) for scan in scans]


def move(T: Tensor, points: Tensor) -> Tensor:
    """Take points (..., N, 3) to another frame."""
    return (points.double() @ T[..., :3, :3].mT + T[..., None, :3, 3]).float()


def rotated(pose: Tensor, rotation: Tensor) -> Tensor:
    """Return the pose with another rotation, at the same place."""
    pose = pose.clone()
    pose[..., :3, :3] = rotation
    return pose


def quaternion(pose: Tensor) -> Tensor:
    """Return the quaternion (w, x, y, z) of a pose."""
    xyzw = Rotation.from_matrix(pose[..., :3, :3].numpy()).as_quat(canonical=True)
    return torch.from_numpy(xyzw).roll(1, -1)


def misread(pose: Tensor | None) -> Tensor:
    """Return the pose whose quaternion (x, y, z, w) was read as (w, x, y, z)."""
    assert pose is not None
    wrong = transform(torch.zeros(1, 3).double(), quaternion(pose).roll(-1, -1))
    return rotated(pose, wrong[..., :3, :3])


def on_misread_base(scan: Scan) -> Tensor:
    """Return the pose of the sensor, mounted as it should be on a base whose quaternion is misread."""
    assert scan.T_map_base is not None
    return misread(scan.T_map_base) @ torch.linalg.inv(scan.T_map_base) @ scan.T_map_sensor


def with_legs(scan: Scan) -> Tensor:
    """Return the points, and 240 on four legs that move with the base."""
    assert scan.T_map_base is not None
    spread = torch.rand(1, 240, 3, generator=torch.Generator().manual_seed(0)) * torch.tensor([0.1, 0.1, 0.3])
    hips = torch.tensor([[0.25, 0.1, -0.4], [0.25, -0.2, -0.4], [-0.35, 0.1, -0.4], [-0.35, -0.2, -0.4]])
    T_sensor_base = torch.linalg.inv(scan.T_map_sensor) @ scan.T_map_base
    return torch.cat([scan.points, move(T_sensor_base, spread + hips.repeat(60, 1))], 1)


def then_standing(scans: list[Scan]) -> list[Scan]:
    """Let the robot stand for two seconds at the end."""
    return scans + scans[-1:] * 10


def late(scans: list[Scan]) -> list[Scan]:
    """Give each scan the pose of the one three steps before."""
    poses = [scans[max(0, k - 3)].T_map_sensor for k in range(len(scans))]
    return [scan._replace(T_map_sensor=T) for scan, T in zip(scans, poses, strict=True)]


def sinking(scans: list[Scan], total: float = 0.3) -> list[Scan]:
    """Let the poses drift down, until the last one is `total` [m] too low."""
    n = len(scans)
    return [s._replace(T_map_sensor=shifted(s.T_map_sensor, z=-total * k / n)) for k, s in enumerate(scans)]


def shifted(pose: Tensor | None, x: float = 0.0, z: float = 0.0) -> Tensor:
    """Return the pose moved along the map's axes [m]."""
    assert pose is not None
    change = torch.zeros(4, 4, dtype=pose.dtype)
    change[0, 3], change[2, 3] = x, z
    return pose + change


def in_optical_axes(scan: Scan) -> Tensor:
    """Return the points in the axes of a camera's optical frame."""
    T_sensor_optical = change_axes(torch.eye(4, dtype=torch.float64), "forward", "optical")
    return move(torch.linalg.inv(T_sensor_optical), scan.points)


SMALL = ElevationMapConfig(grid=GridConfig(resolution=0.05, length_x=4.0, length_y=4.0))
NO_EXCLUSION = ElevationMapConfig(grid=GRID, sensor=SensorConfig(exclusion=None))
LOW_FLOORS = ElevationMapConfig(grid=GRID, overlap=OverlapConfig(height=0.3, base_height=0.3))
NO_DRIFT = ElevationMapConfig(grid=GRID, drift=None)
FAR = each(T_map_sensor=lambda s: shifted(s.T_map_sensor, 3.0), T_map_base=lambda s: shifted(s.T_map_base, 3.0))
CASES = {
    "millimetres": Case(each(points=lambda s: 1000 * s.points)),
    "map-frame": Case(each(points=lambda s: move(s.T_map_sensor, s.points))),
    "optical": Case(each(points=in_optical_axes)),
    "opengl": Case(each(
        points=in_optical_axes,
        T_map_sensor=lambda s: change_axes(s.T_map_sensor, "forward", "opengl"),
    )),
    "quaternion": Case(each(T_map_sensor=lambda s: misread(s.T_map_sensor))),
    "base-quaternion": Case(each(T_map_sensor=on_misread_base, T_map_base=lambda s: misread(s.T_map_base))),
    "inverted": Case(each(T_map_sensor=lambda s: torch.linalg.inv(s.T_map_sensor))),
    "pitch": Case(each(T_map_sensor=lambda s: s.T_map_sensor @ mount(4.0, z=0.0)), scene="boxes"),
    "no-base": Case(each(T_map_base=lambda s: None), given=FAR, right=SMALL, wrong=SMALL),
    "low-base": Case(each(T_map_base=lambda s: shifted(s.T_map_base, z=-3.0))),
    "late": Case(late),
    "legs": Case(each(points=with_legs), given=then_standing, right=SMALL, wrong=SMALL),
    "ceiling": Case(list, scene="overhang", pitch_deg=0.0, wrong=NO_EXCLUSION),
    "floors": Case(list, wrong=LOW_FLOORS),
    "drift": Case(list, scene="flat", given=sinking, wrong=NO_DRIFT),
    "axes": Case(list, drawn_wrong=True),
}  # fmt: skip
