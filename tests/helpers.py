"""What the tests share: small configs, poses, clouds, random states, and how two states are compared."""

import math
import sys
import time

import numpy as np
import torch

from torchelev import ElevationMap, ElevationMapConfig, GridConfig
from torchelev.state import MapState, Statistics, blank_state


def small_config(cells=(12, 10), resolution=0.1, **stages):
    """A config of a small window; `stages` replaces whole groups."""
    grid = GridConfig(resolution=resolution, length_x=cells[0] * resolution, length_y=cells[1] * resolution)
    return ElevationMapConfig(grid=grid, **stages)


def small_map(num_envs=1, cells=(12, 10), resolution=0.1, dtype=torch.float32, **stages):
    """A map of a small window."""
    cfg = small_config(cells, resolution, **stages)
    return ElevationMap(cfg, num_envs=num_envs).to(dtype)


def rotation(yaw=0.0, pitch=0.0, roll=0.0):
    """Rotation matrix Rz(yaw) Ry(pitch) Rx(roll), NumPy float64."""
    cy, sy, cp, sp, cr, sr = (f(a) for a in (yaw, pitch, roll) for f in (math.cos, math.sin))
    Rz = np.array([[cy, -sy, 0], [sy, cy, 0], [0, 0, 1]])
    Ry = np.array([[cp, 0, sp], [0, 1, 0], [-sp, 0, cp]])
    Rx = np.array([[1, 0, 0], [0, cr, -sr], [0, sr, cr]])
    return Rz @ Ry @ Rx


def pose(position=(0.0, 0.0, 1.0), yaw=0.0, pitch=0.0, roll=0.0, num_envs=1):
    """The same pose (B, 4, 4) float64 for every environment."""
    T = torch.eye(4, dtype=torch.float64)
    T[:3, :3] = torch.from_numpy(rotation(yaw, pitch, roll))
    T[:3, 3] = torch.tensor(position, dtype=torch.float64)
    return T.repeat(num_envs, 1, 1)


def random_poses(rng, num_envs, tilt=0.3, reach=0.3, height=(0.8, 1.5)):
    """Sensor poses (B, 4, 4) float64 at random places near the origin."""
    poses = []
    for _ in range(num_envs):
        position = (*rng.uniform(-reach, reach, 2), rng.uniform(*height))
        poses.append(pose(position, rng.uniform(-3, 3), rng.uniform(-tilt, tilt), rng.uniform(-tilt, tilt)))
    return torch.cat(poses)


def off_borders(xy, resolution, margin=0.1):
    """Move points towards the middle of their lattice cell, so that rounding cannot put them into another."""
    cell = np.floor(xy / resolution)
    return (cell + margin + (1 - 2 * margin) * (xy / resolution - cell)) * resolution


def terrain(rng, num_points, cells=(12, 10), resolution=0.1, roughness=0.02, overshoot=1.2):
    """Map-frame points (N, 3), NumPy float64, of gently sloped ground around z = 0, some outside the window."""
    half = np.array(cells) * resolution / 2 * overshoot
    xy = off_borders(rng.uniform(-half, half, (num_points, 2)), resolution)
    slope = rng.uniform(-0.2, 0.2, 2)
    return np.column_stack([xy, xy @ slope + rng.normal(0, roughness, num_points)])


def seen_from(T_map_sensor, points, dtype=torch.float64):
    """Map-frame points (B, N, 3) or (N, 3), in the frame of each sensor (B, 4, 4)."""
    points = torch.as_tensor(points, dtype=torch.float64).expand(len(T_map_sensor), -1, 3)
    return ((points - T_map_sensor[:, None, :3, 3]) @ T_map_sensor[:, :3, :3]).to(dtype)


def random_clouds(rng, T_map_sensor, num_points, dtype=torch.float32, **ground):
    """A different random cloud (B, N, 3) for each sensor pose."""
    return torch.cat([seen_from(T[None], terrain(rng, num_points, **ground), dtype) for T in T_map_sensor])


def nans(num_envs, num_points=4):
    """Clouds without a single return."""
    return torch.full((num_envs, num_points, 3), torch.nan)


def random_state(rng, grid, num_envs=1, known=0.6, dtype=torch.float64):
    """A state whose every layer is filled at random, as stages may meet it."""
    shape = (num_envs, grid.height, grid.width)

    def draw(low, high):
        return torch.from_numpy(rng.uniform(low, high, shape)).to(dtype)

    validity = draw(0, 1) < known
    return blank_state(grid, num_envs, "cpu", dtype)._replace(
        elapsed=3_000_000_000 + torch.arange(num_envs),
        elevation=torch.where(validity, draw(-0.3, 0.3), 0.0),
        variance=draw(1e-5, 1e-2),
        validity=validity,
        support=torch.where(validity, torch.floor(draw(0, 20)), 0.0),
        time=draw(0, 2),
        upper_bound=draw(-0.3, 0.6),
        bounded=~validity & (draw(0, 1) < 0.5),
        gradient_x=torch.where(validity, draw(-0.3, 0.3), 0.0),
        gradient_y=torch.where(validity, draw(-0.3, 0.3), 0.0),
        has_normal=validity.clone(),
        traversability=torch.where(validity, draw(0, 1), 0.0),
        rated=validity.clone(),
        challenger=torch.where(validity, draw(-0.3, 0.6), 0.0),
        challenger_support=torch.where(validity, torch.floor(draw(0, 6)), 0.0).to(torch.uint8),
    )


def snapshot(emap):
    """A copy of everything that a map holds, statistics included."""
    state = emap.state
    statistics = Statistics(*(v.clone() for v in state.statistics))
    return MapState(*(v.clone() for v in state[:-1]), statistics)


def differences(a, b, skip=()):
    """Names of the layers and statistics in which two states differ by any bit."""
    layers = [n for n in MapState._fields[:-1] if not torch.equal(getattr(a, n), getattr(b, n))]
    counts = [n for n in Statistics._fields if not torch.equal(getattr(a.statistics, n), getattr(b.statistics, n))]
    return [n for n in layers + counts if n not in skip]


def assert_close(a, b, tolerance=1e-5, skip=()):
    """Two states agree: masks and cells exactly, heights and the like within the tolerance (variances relatively)."""
    for name in MapState._fields[:-1]:
        left, right = getattr(a, name), getattr(b, name)
        if name in skip:
            continue
        if name == "upper_bound":  # holds anything where not bounded
            left, right = (torch.where(s.bounded, s.upper_bound, 0.0) for s in (a, b))
        if not left.is_floating_point():
            assert torch.equal(left, right), f"{name} differs in {(left != right).sum()} places"
        else:
            torch.testing.assert_close(left, right, atol=tolerance, rtol=tolerance, msg=lambda m, n=name: f"{n}: {m}")


def floats_finite(state):
    """Names of the layers and statistics that hold NaN or inf."""
    values = {**state._asdict(), **state.statistics._asdict()}
    values.pop("statistics")
    return [n for n, v in values.items() if v.is_floating_point() and not torch.isfinite(v).all()]


def scan(seed, num_envs=2, num_points=300, dtype=torch.float32):
    """Clouds and the poses they were taken from."""
    rng = np.random.default_rng(seed)
    T = random_poses(rng, num_envs)
    return random_clouds(rng, T, num_points, dtype), T


def mapped(num_envs=2, scans=2, pose_covariance=None, **stages):
    """A map after a few scans."""
    emap = small_map(num_envs, **stages)
    for k in range(scans):
        cloud, T = scan(k, num_envs)
        emap.update(cloud, T, T, 0.3, pose_covariance=pose_covariance)
    return emap


class NoGenerator:
    """Stands in for `torch.Generator` on "meta", which has none."""

    def __init__(self, device):
        pass

    def manual_seed(self, seed):
        return None


def wait_for(claim, seconds=10.0):
    """Wait until a claim is true; fail if it is not in time."""
    end = time.monotonic() + seconds
    while not claim():
        assert time.monotonic() < end
        time.sleep(0.01)


def without(monkeypatch, module):
    """Let an import of a module raise ImportError, as where it is not installed."""
    monkeypatch.setitem(sys.modules, module, None)
