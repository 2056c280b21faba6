"""How TerrainNav's base moves: it follows velocity commands, slows on slopes, is blocked by steps and falls off ledges.

No physics engine: four substeps of kinematics over the height field, for all environments at once.
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
    """Where the bases are and how they move."""

    xy: Tensor  # (B, 2) [m] tile frame
    yaw: Tensor  # (B,) [rad]
    velocity: Tensor  # (B, 2) forward [m/s], yaw rate [rad/s]
    blocked: Tensor  # (B,) bool: a step too high, now
    fallen: Tensor  # (B,) bool


class Ground:
    """The tiles as feet meet them: the ground's height and the highest within `reach`."""

    def __init__(self, field: HeightField, reach: float) -> None:
        radius = max(1, round(reach / field.resolution))
        highest = F.max_pool2d(field.heights[:, None], 2 * radius + 1, 1, radius)[:, 0]
        self.field, self.highest = field, HeightField(highest, field.resolution)


def contacts(xy: Tensor, yaw: Tensor, cfg: BodyConfig) -> Tensor:
    """Return the footprint's corners and the middles of its sides (B, 8, 2) [m]; the corners are the feet."""
    points = _footprint(cfg.length / 2, cfg.width / 2, xy.device)
    cos, sin = yaw.cos()[:, None], yaw.sin()[:, None]
    x, y = cos * points[:, 0] - sin * points[:, 1], sin * points[:, 0] + cos * points[:, 1]
    return torch.stack([x, y], -1) + xy[:, None]


@functools.cache  # a list becomes a tensor on a GPU by a copy that the host waits for
def _footprint(a: float, b: float, device: torch.device) -> Tensor:
    points = [(a, b), (a, -b), (-a, b), (-a, -b), (a, 0), (-a, 0), (0, b), (0, -b)]
    with torch.inference_mode(False):
        return torch.tensor(points, device=device)


def base_pose(xy: Tensor, yaw: Tensor, tile_ids: Tensor, field: HeightField, cfg: BodyConfig) -> Tensor:
    """Return T_map_base (B, 4, 4): over the feet, tilted as the plane through them."""
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
    """Move for one substep of dt [s]; `action` (B, 2) in [-1, 1]: forward speed and yaw rate.

    The velocity approaches the command in `response` seconds. A substep after which ground within `reach` of the
    footprint lies `max_climb` above the feet is not taken; one after which ground under the footprint lies `max_drop`
    below them is a fall. Speed falls linearly with the gradient under the feet, as if to 0 at `max_slope`, but not
    below a fifth.
    """
    forward = action[:, 0] * torch.where(action[:, 0] > 0, cfg.max_speed, cfg.max_speed / 3)
    command = torch.stack([forward, action[:, 1] * cfg.max_yaw_rate], -1)
    velocity = state.velocity + (command - state.velocity) * min(1.0, dt / cfg.response)
    feet = ground.field.height(tile_ids, contacts(state.xy, state.yaw, cfg)[:, :4])
    support = feet.mean(1)
    gradient = (feet.amax(1) - feet.amin(1)) / cfg.length
    slowed = velocity[:, 0] * (1 - gradient / cfg.max_slope).clamp(0.2, 1.0)
    yaw = state.yaw + velocity[:, 1] * dt
    xy = state.xy + (slowed * dt)[:, None] * torch.stack([yaw.cos(), yaw.sin()], -1)
    touched = contacts(xy, yaw, cfg)
    blocked = (ground.highest.height(tile_ids, touched).amax(1) - support > cfg.max_climb) & ~state.fallen
    fallen = (support - ground.field.height(tile_ids, touched).amin(1) > cfg.max_drop) & ~blocked | state.fallen
    stays = blocked | fallen
    return RobotState(
        xy=torch.where(stays[:, None], state.xy, xy),
        yaw=torch.where(stays, state.yaw, yaw),
        velocity=torch.where(stays[:, None], 0.0, velocity),
        blocked=blocked,
        fallen=fallen,
    )
