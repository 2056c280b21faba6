"""The simulated world: tiles of ground, robots of all sizes, and their walks."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor

from envs.terrain_nav import BodyConfig
from envs.terrain_nav.robot import base_pose
from torchelev.robot import RobotConfig
from torchelev.sim import CourseConfig, HeightField, make_course, make_terrain
from torchelev.sim.poses import pose_from_rotation_vector

# Fixed before the first training. "obstacles" are the blocks, pits and steps of TerrainNav's course.
KINDS = ("slope", "stairs_up", "stairs_down", "boxes", "gaps", "rough", "rails", "obstacles")
UNSEEN_KINDS = ("stepping_stones",)  # never trained on

LENGTH, RESOLUTION = 8.0, 0.02  # [m] side of a tile and distance of its samples
_STRETCH = (0.5, 2.0)  # factor on a tile's heights, for slopes and steps that robots cannot overcome
_MAX_GRADIENT = 0.2  # of the plane that is added to a tile
RIM = 1.0  # [m] smallest distance of walks from a tile's rim
LOOK_INTERVAL = 0.3  # [s]
CANDIDATES = 4  # walks, of which a robot takes the easiest
_SWAY = 0.02  # [rad] 1 sigma about each axis

LENGTHS = (0.4, 1.0)  # [m] of a robot
# Uniform fractions of the length; those of a robot of 0.7 m are in the middle of most.
FRACTIONS = {
    "width": (0.4, 0.8),
    "foot_radius": (0.03, 0.06),
    "foot_reach": (0.1, 0.2),
    "step_height": (0.15, 0.35),
    "clearance": (0.3, 0.5),
}
_MAX_SLOPES = (0.3, 0.7)  # [rad]


def draw_robot(rng: np.random.Generator) -> RobotConfig:
    """Draw a robot of 0.4 to 1.0 m length whose other sizes are random fractions of it."""
    length = rng.uniform(*LENGTHS)
    sizes = {name: length * rng.uniform(*limits) for name, limits in FRACTIONS.items()}
    return RobotConfig(length=length, max_slope=rng.uniform(*_MAX_SLOPES), **sizes)


def make_tiles(kinds: Sequence[str], rng: np.random.Generator) -> HeightField:
    """Make a tile of each kind, of random difficulty, stretched and tilted at random."""
    return HeightField(torch.stack([_tile(kind, rng) for kind in kinds]), RESOLUTION)


def _tile(kind: str, rng: np.random.Generator) -> Tensor:
    seed, difficulty = int(rng.integers(2**31)), float(rng.random())
    stretch, gradient, heading = rng.uniform(*_STRETCH), rng.uniform(0, _MAX_GRADIENT), rng.uniform(-math.pi, math.pi)
    axis = (torch.arange(round(LENGTH / RESOLUTION) + 1) - LENGTH / RESOLUTION / 2) * RESOLUTION
    if kind == "obstacles":
        course = CourseConfig(num_tiles=1, length=LENGTH, resolution=RESOLUTION, seed=seed, num_routes=1)
        heights = make_course(course).field.heights[0]
    else:
        at = torch.tensor([difficulty])
        heights = make_terrain(kind, at, length=LENGTH, resolution=RESOLUTION, seed=seed).field.heights[0]
    tilt = gradient * (math.cos(heading) * axis[:, None] + math.sin(heading) * axis)
    return heights * stretch + tilt


def _highest(heights: Tensor, cells: int) -> Tensor:
    """Return the highest sample within `cells` samples along each axis (K, H, W)."""
    rows = F.max_pool2d(heights[:, None], (2 * cells + 1, 1), 1, (cells, 0))
    return F.max_pool2d(rows, (1, 2 * cells + 1), 1, (0, cells))[:, 0]


def _mean(heights: Tensor, cells: int) -> Tensor:
    padded = F.pad(heights[:, None], (cells,) * 4, mode="replicate")
    return F.avg_pool2d(F.avg_pool2d(padded, (2 * cells + 1, 1), 1), (1, 2 * cells + 1), 1)[:, 0]


class Footing:
    """The mean, highest and range of the heights within half a body's length of each place."""

    def __init__(self, field: HeightField, robot: RobotConfig) -> None:
        cells = round(robot.length / 2 / field.resolution)
        highest = _highest(field.heights, cells)
        closed = -_highest(
            -highest, cells
        )  # a body does not sink into gaps that are narrower than the distance of its feet
        lowest = -_highest(-field.heights, cells)
        self.robot = robot
        self.mean, self.highest = (HeightField(z, field.resolution) for z in (_mean(closed, cells), highest))
        self.range = HeightField(highest - lowest, field.resolution)

    def pose(self, tile_ids: Tensor, xy: Tensor, yaw: Tensor) -> Tensor:
        """Return T_tile_base (B, 4, 4), float64: tilted like the ground and above it everywhere."""
        height = self.robot.clearance + 0.2 * self.robot.length
        body = BodyConfig(length=self.robot.length, width=self.robot.width, body_height=height)
        T = base_pose(xy, yaw, tile_ids, self.mean, body)
        T[:, 2, 3] = T[:, 2, 3].maximum(self.highest.height(tile_ids, xy[:, None])[:, 0] + 0.1)
        return T.double()


def walks(footing: Footing, num: int, looks: int, rng: np.random.Generator) -> Tensor:
    """Return T_tile_base (looks, num, 4, 4) of smooth random walks, one on each tile.

    Each robot takes, of several candidates, the walk over the ground with the smallest range of heights.
    """
    xy, yaw = (torch.from_numpy(value).float() for value in _candidates(CANDIDATES * num, looks, rng))
    tile_ids = torch.arange(num).repeat(CANDIDATES)
    hardest = footing.range.height(tile_ids, xy).amax(1).view(CANDIDATES, num)
    chosen = hardest.argmin(0) * num + torch.arange(num)
    poses = torch.stack([footing.pose(torch.arange(num), xy[chosen, k], yaw[chosen, k]) for k in range(looks)])
    turn = torch.from_numpy(rng.normal(0, _SWAY, (looks * num, 3)))
    return poses @ pose_from_rotation_vector(turn, torch.zeros_like(turn)).view_as(poses)


def _candidates(num: int, looks: int, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    """Draw places (num, looks, 2) [m] and headings (num, looks) [rad] with constant speeds and sinusoidal yaw rates."""
    half, time = LENGTH / 2 - RIM, LOOK_INTERVAL * np.arange(looks)
    start, speed = rng.uniform(-half, half, (num, 1, 2)), rng.uniform(0, 1, (num, 1))
    rate, period, phase = rng.uniform(-0.8, 0.8, (num, 1)), rng.uniform(3, 10, (num, 1)), rng.uniform(0, 1, (num, 1))
    swing = rate * np.cos(2 * math.pi * (time / period + phase))
    yaw = rng.uniform(-math.pi, math.pi, (num, 1)) + np.cumsum(swing * LOOK_INTERVAL, 1)
    step = (speed * LOOK_INTERVAL)[..., None] * np.stack([np.cos(yaw), np.sin(yaw)], -1)
    return np.clip(start + np.cumsum(step, 1) - step, -half, half), yaw
