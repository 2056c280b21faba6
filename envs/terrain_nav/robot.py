"""Motion of TerrainNav's base: it follows velocity commands, slows on slopes, is blocked by steps and falls off ledges.

This is kinematics over a height field, without a physics engine, for all environments at once.
"""

from __future__ import annotations

import functools
from typing import NamedTuple

import torch
import torch.nn.functional as F
from torch import Tensor

from envs.terrain_nav.config import BodyConfig
from torchelev.sim.terrains.heightfield import HeightField


class RobotState(NamedTuple):
    """Position and motion of B bases."""

    xy: Tensor  #: (B, 2) [m] tile frame
    yaw: Tensor  #: (B,) [rad]
    velocity: Tensor  #: (B, 2) forward speed [m/s], yaw rate [rad/s]
    blocked: Tensor  #: (B,) bool, whether a step that is too high blocks the robot now
    fallen: Tensor  #: (B,) bool, whether the robot has fallen


class Ground:
    """Height of the ground, and the highest ground within `reach` [m], on each tile."""

    def __init__(self, field: HeightField, reach: float) -> None:
        radius = max(1, round(reach / field.resolution))
        highest = F.max_pool2d(field.heights[:, None], 2 * radius + 1, 1, radius)[:, 0]
        self.field, self.highest = field, HeightField(highest, field.resolution)


def contacts(xy: Tensor, yaw: Tensor, cfg: BodyConfig) -> Tensor:
    """Return the corners of the footprint, which are the feet, and the centres of its sides (B, 8, 2) [m]."""
    points = _footprint(cfg.length / 2, cfg.width / 2, xy.device)
    cos, sin = yaw.cos()[:, None], yaw.sin()[:, None]
    x, y = cos * points[:, 0] - sin * points[:, 1], sin * points[:, 0] + cos * points[:, 1]
    return torch.stack([x, y], -1) + xy[:, None]


@functools.cache  # making a GPU tensor from a list synchronises with the host
def _footprint(a: float, b: float, device: torch.device) -> Tensor:
    points = [(a, b), (a, -b), (-a, b), (-a, -b), (a, 0), (-a, 0), (0, b), (0, -b)]
    with torch.inference_mode(False):
        return torch.tensor(points, device=device)


def base_pose(xy: Tensor, yaw: Tensor, tile_ids: Tensor, field: HeightField, cfg: BodyConfig) -> Tensor:
    """Return T_map_base (B, 4, 4): above the feet, tilted like the plane through them."""
    feet = field.height(tile_ids, contacts(xy, yaw, cfg)[:, :4])
    front, rear, left, right = (feet[:, pair].mean(1) for pair in ((0, 1), (2, 3), (0, 2), (1, 3)))
    zero, one = torch.zeros_like(yaw), torch.ones_like(yaw)
    ahead = F.normalize(torch.stack([yaw.cos(), yaw.sin(), (front - rear) / cfg.length], -1), dim=-1)
    aside = torch.stack([-yaw.sin(), yaw.cos(), (left - right) / cfg.width], -1)
    up = F.normalize(torch.linalg.cross(ahead, aside), dim=-1)
    rotation = torch.stack([ahead, torch.linalg.cross(up, ahead), up], -1)
    position = torch.cat([xy, (feet.mean(1) + cfg.body_height)[:, None]], -1)
    last = torch.stack([zero, zero, zero, one], -1)[:, None]
    return torch.cat([torch.cat([rotation, position[..., None]], -1), last], 1)


def advance(
    state: RobotState, action: Tensor, tile_ids: Tensor, ground: Ground, cfg: BodyConfig, dt: float
) -> RobotState:
    """Move for one substep.

    The velocity follows the command with the time constant `response`. The speed decreases linearly with the gradient
    under the feet, to 0 at `max_slope`, but not below a fifth. A robot does not move if after the substep ground within
    `reach` of its footprint would lie `max_climb` above its feet (blocked), or if ground under its footprint would lie
    `max_drop` below them (fallen).

    Args:
        state: The robots before the substep.
        action: Forward speed and yaw rate (B, 2), from -1 to 1.
        tile_ids: The tile of each robot (B,).
        ground: The tiles.
        cfg: The body.
        dt: Duration of the substep [s].
    """
    forward = action[:, 0] * torch.where(action[:, 0] > 0, cfg.max_speed, cfg.max_speed / 3)
    command = torch.stack([forward, action[:, 1] * cfg.max_yaw_rate], -1)
    velocity = state.velocity + (command - state.velocity) * min(1.0, dt / cfg.response)
    feet = ground.field.height(tile_ids, contacts(state.xy, state.yaw, cfg)[:, :4])
    support = feet.mean(1)
    gradient = (feet.amax(1) - feet.amin(1)) / cfg.length
    speed = velocity[:, 0] * (1 - gradient / cfg.max_slope).clamp(0.2, 1.0)
    yaw = state.yaw + velocity[:, 1] * dt
    xy = state.xy + (speed * dt)[:, None] * torch.stack([yaw.cos(), yaw.sin()], -1)
    points = contacts(xy, yaw, cfg)
    blocked = (ground.highest.height(tile_ids, points).amax(1) - support > cfg.max_climb) & ~state.fallen
    fallen = (support - ground.field.height(tile_ids, points).amin(1) > cfg.max_drop) & ~blocked | state.fallen
    stays = blocked | fallen
    return RobotState(
        xy=torch.where(stays[:, None], state.xy, xy),
        yaw=torch.where(stays, state.yaw, yaw),
        velocity=torch.where(stays[:, None], 0.0, velocity),
        blocked=blocked,
        fallen=fallen,
    )
