"""Simulated walks, the maps of them, and poses of a misread quaternion."""

import numpy as np
import torch

from torchelev import ElevationMap, ElevationMapConfig, GridConfig
from torchelev.frames.quaternions import to_quaternion, to_rotation
from torchelev.sim import DepthCamera, Lidar, mount, walk
from torchelev.sim.exact import scenes as library

DT = 0.2  # [s]
CFG = ElevationMapConfig(grid=GridConfig(resolution=0.08, length_x=8.0, length_y=8.0))
SENSORS = {"camera": (DepthCamera(width=80, height=60, max_range=6.0), 35.0), "lidar": (Lidar(azimuths=256), 0.0)}


def map_of(scans, mistake=lambda *scan: scan, dt=DT, cfg=CFG):
    emap = ElevationMap(cfg)
    for scan in scans:
        emap.update(*mistake(*scan), dt=dt)
    return emap


def reordered(T, shift):
    """The pose that results if the order of the quaternion's entries is mistaken."""
    T = T.clone()
    T[0, :3, :3] = torch.from_numpy(to_rotation(np.roll(to_quaternion(T[0, :3, :3].numpy()), shift)))
    return T


def on_reordered_base(shift):
    """The sensor is mounted as it should be on a base whose quaternion is misread."""

    def mistake(points, T, base):
        wrong = reordered(base, shift)
        return points, wrong @ torch.linalg.inv(base) @ T, wrong

    return mistake


def sound_scene(seed):
    """A random terrain, sensor, mount, speed and window -> scene, sensor, path, config, whether the base is known."""
    rng = np.random.default_rng(seed)
    kinds = [lambda: library.slope(rng.uniform(0, 30)), lambda: library.rough(seed), library.stairs,
             lambda: library.boxes(seed), lambda: library.mixed(seed), library.wall, library.overhang,
             lambda: library.person(2.0), library.flat]  # fmt: skip
    scene = kinds[rng.integers(len(kinds))]()
    if rng.random() < 0.6:
        sensor, pitch = DepthCamera(width=64, height=48, max_range=rng.uniform(4, 10)), rng.uniform(10, 50)
    else:
        rings, top = int(rng.choice([8, 16, 32])), rng.choice([15, 45])
        sensor = Lidar(rings, 256, fov_high_deg=float(top), max_range=rng.uniform(8, 40))
        pitch = rng.uniform(-5, 20)
    start, end = rng.uniform(-2, 2, (2, 2))
    T_base_sensor = mount(pitch, z=float(rng.choice([0.1, 0.25, 0.5, 1.5])))
    path = walk(scene, [tuple(start), tuple(end)], speed=rng.uniform(0.2, 1.5), dt=DT, T_base_sensor=T_base_sensor)
    size, resolution = float(rng.choice([4, 8, 16])), float(rng.choice([0.04, 0.1, 0.2]))
    grid = GridConfig(resolution=resolution, length_x=size, length_y=size)
    knows_base = size == 4 or rng.random() < 0.8  # a window of 4 m that does not follow the robot is a mistake
    return scene, sensor, path, ElevationMapConfig(grid=grid), knows_base
