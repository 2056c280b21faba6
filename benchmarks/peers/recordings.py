"""The recordings: simulated ones whose ground is known exactly, and real ones of which three tenths are held out."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from benchmarks.peers.peer import Array, Cells, Frame, Setup
from torchelev.io import open_recording
from torchelev.sim import Box, DepthCamera, Lidar, PoseErrors, Scene, mount, noisy, preset, walk
from torchelev.sim.exact.scenes import mixed, rough, stairs
from torchelev.sim.exact.trajectories import Point

RESOLUTION, SIDE, DT, SPEED = 0.05, 8.0, 0.1, 0.5  # [m], [m], [s], [m/s]
LOW = (-3.0, -4.0)  # [m] corner of the area
CAMERA, LIDAR = DepthCamera(), Lidar(rings=32, azimuths=512)
T_CAMERA, T_LIDAR = mount(pitch_deg=35.0), mount(pitch_deg=0.0)
HELD_OUT = 0.3  # share of a real scan's points
REAL_RESOLUTION, REAL_SIDE, REAL_RANGE = 0.1, 20.0, 20.0  # [m]
FEWEST = 200  # cells of a real recording whose ground is known
AGREE = 0.1  # [m] most that the points of a cell may differ
NEAR = 0.05  # [m] of the truth, within which a point says that its cell was seen


@dataclass
class Recording:
    """Scans with poses, and what the ground was."""

    name: str
    setup: Setup
    frames: list[Frame]
    truth: Callable[[int], Array]  #: of the ground (H, W) [m] after a scan, NaN where it is not known
    seen: Array  #: (H, W) where the ground was hit by a point
    reads: list[int] = field(default_factory=list)  #: scans after which the ground is read; the last one always is
    changed: Array | None = None  #: (H, W) where something appeared or went
    events: list[int] = field(default_factory=list)  #: scans at which it did


def _setup(sensor: DepthCamera | Lidar, height: float) -> Setup:
    pinhole = None
    if isinstance(sensor, DepthCamera):
        K = sensor.intrinsics
        values = [float(value) for value in (K[0, 0], K[1, 1], K[0, 2], K[1, 2])]
        pinhole = (sensor.width, sensor.height, *values)
    cells = (round(SIDE / RESOLUTION),) * 2
    return Setup(RESOLUTION, LOW, cells, sensor.max_range, height, pinhole)  # type: ignore[arg-type]


def _simulate(
    name: str,
    scene: Scene,
    path: list[Point],
    sensor: DepthCamera | Lidar,
    T_base_sensor: Tensor,
    drift: bool = False,
    speed: float = SPEED,
) -> Recording:
    """Walk along a path; with `drift`, the poses that are told are those of a leg odometry."""
    poses = walk(scene, path, speed=speed, dt=DT, T_base_sensor=T_base_sensor)
    generator = torch.Generator().manual_seed(0)
    errors = PoseErrors(preset("leg_odometry").pose, 1, seed=0) if drift else None
    height = float(poses.T_map_sensor[0, 2, 3] - scene.truth(poses.T_map_sensor[0, :2, 3]))
    setup, frames = _setup(sensor, height), []
    cells = Cells(setup)
    seen = np.zeros(len(cells.sum), bool)
    for T_base, T_sensor, t in zip(*poses, strict=True):
        points = noisy(sensor.cast(scene, T_sensor, float(t)), generator)
        believed = T_base if errors is None else errors(T_base[None], DT)[0].double()
        told = believed @ torch.linalg.inv(T_base)
        frames.append(Frame(points.numpy(), (told @ T_sensor).numpy(), believed.numpy(), DT))
        placed = frames[-1].placed()
        number, inside = cells.number(placed)
        true = _truth(scene, inside[:, :2], told, float(t))
        seen[number[np.abs(true - inside[:, 2]) < NEAR]] = True
    centers = cells.centers()

    def truth(scan: int) -> Array:
        return _truth(scene, centers, told, float(poses.times[scan]))

    return Recording(name, setup, frames, truth, seen.reshape(setup.cells))


def _truth(scene: Scene, xy: Array, told: Tensor, t: float) -> Array:
    """Return the ground [m] at places of the frame of the poses that are told."""
    back = torch.linalg.inv(told).numpy()
    true = xy @ back[:2, :2].T + back[:2, 3]
    return (scene.truth(torch.from_numpy(true), t) + told[2, 3]).numpy()  # type: ignore[no-any-return]


def _with_change(name: str, box: Box, sensor: DepthCamera | Lidar, T_base_sensor: Tensor) -> Recording:
    """Walk slowly towards a box that is there for a while."""
    path: list[Point] = [(-1.5, 0.0), (0.3, 0.0)]
    found = _simulate(name, Scene(boxes=(box,)), path, sensor, T_base_sensor, speed=0.15)
    x, y = np.moveaxis(Cells(found.setup).centers(), -1, 0)
    inside = (x > box.low[0]) & (x < box.high[0]) & (y > box.low[1]) & (y < box.high[1])
    found.changed = inside
    found.events = [round(time / DT) for time in (box.since, box.until) if np.isfinite(time)]
    found.reads = list(range(0, len(found.frames), 4))
    return found


def simulated() -> Iterator[Recording]:
    """Yield the simulated recordings."""
    yield _simulate("stairs", stairs(), [(-2.0, 0.0), (2.0, 0.0)], CAMERA, T_CAMERA)
    yield _simulate("mixed", mixed(), [(-2.0, 0.0), (0.8, 0.0), (0.0, 1.0)], CAMERA, T_CAMERA)
    yield _simulate("mixed, lidar", mixed(), [(-2.0, 0.0), (0.8, 0.0), (0.0, 1.0)], LIDAR, T_LIDAR)
    yield _simulate("rough, odometry drifts", rough(), [(-2.0, 0.0), (2.0, 0.0)], CAMERA, T_CAMERA, drift=True)
    person = Box(low=(1.7, -0.25, 0.0), high=(2.1, 0.25, 1.7), until=5.0)
    yield _with_change("a person leaves", person, CAMERA, T_CAMERA)
    yield _with_change("a person leaves, lidar", person, LIDAR, T_LIDAR)
    crate = Box(low=(1.4, -0.3, 0.0), high=(2.0, 0.3, 0.4), since=3.0, until=8.0, grounded=True)
    yield _with_change("a crate comes and goes", crate, CAMERA, T_CAMERA)


def real(folder: Path) -> Iterator[Recording]:
    """Yield the recordings of a folder, of which three tenths of the points are held out as truth."""
    for path in sorted(entry for entry in folder.iterdir() if (entry / "poses.txt").exists()):
        frames, held, rng = [], [], np.random.default_rng(0)
        for frame in open_recording(path):
            points = frame.points[np.linalg.norm(frame.points, axis=1) <= REAL_RANGE].astype(np.float32)
            keep, pose = rng.random(len(points)) >= HELD_OUT, np.asarray(frame.T_map_sensor, np.float64)
            frames.append(Frame(points[keep], pose, pose, DT))
            held.append(Frame(points[~keep], pose, pose, DT))
        x, y = frames[0].T_map_sensor[:2, 3]
        low = (_on_lattice(x - REAL_SIDE / 2), _on_lattice(y - REAL_SIDE / 2))
        height = _height_over_ground(frames[0])
        setup = Setup(REAL_RESOLUTION, low, (round(REAL_SIDE / REAL_RESOLUTION),) * 2, REAL_RANGE, height, None)
        truth, seen = _held_out(setup, held, frames)
        if np.isfinite(truth(0)).sum() >= FEWEST:
            yield Recording(path.name, setup, frames, truth, seen)


def _on_lattice(value: float) -> float:
    """Return the nearest border of cells [m], so that cells are those of maps on the same lattice."""
    return float(round(value / REAL_RESOLUTION) * REAL_RESOLUTION)


def _height_over_ground(frame: Frame) -> float:
    """Return how high a sensor stands over the low points within 3 m [m]."""
    placed, origin = frame.placed(), frame.T_map_sensor[:3, 3]
    near = np.hypot(*(placed[:, :2] - origin[:2]).T) < 3.0
    return float(origin[2] - np.quantile(placed[near, 2], 0.1))


def _held_out(setup: Setup, held: list[Frame], frames: list[Frame]) -> tuple[Callable[[int], Array], Array]:
    """Return the median of the held-out points of each cell, and the cells of the other points.

    NaN where there are fewer than three, or where the points of the cell disagree, the others included: below trees and
    at walls no height is the true one, also if all held-out points hit the leaves.
    """
    cells = Cells(setup)
    number, points = cells.number(np.concatenate([frame.placed() for frame in held]))
    order = np.lexsort([points[:, 2], number])
    number, z = number[order], points[order, 2]
    first, count = np.unique(number, return_index=True, return_counts=True)[1:]
    truth = np.full(len(cells.sum), np.nan)
    truth[number[first]] = np.where(count >= 3, z[first + count // 2], np.nan)
    truth[_range(cells, held + frames) > AGREE] = np.nan
    for frame in frames:
        cells.add(frame.placed())
    truth = truth.reshape(setup.cells)
    return (lambda scan: truth), (cells.count > 0).reshape(setup.cells)


def _range(cells: Cells, frames: list[Frame]) -> Array:
    """Return highest less lowest point of each cell [m]."""
    number, points = cells.number(np.concatenate([frame.placed() for frame in frames]))
    high, low = np.full(len(cells.sum), -np.inf), np.full(len(cells.sum), np.inf)
    np.maximum.at(high, number, points[:, 2])
    np.minimum.at(low, number, points[:, 2])
    return high - low
