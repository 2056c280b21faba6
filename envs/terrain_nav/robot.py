"""Motion of TerrainNav's base: it follows velocity commands, slows on slopes, is blocked by steps and falls off ledges.

Where its body meets a box, it falls, too.

This is kinematics over a height field, without a physics engine, for all environments at once.
"""

from __future__ import annotations

import functools
from typing import NamedTuple

import torch
import torch.nn.functional as F
from torch import Tensor

from envs.terrain_nav.config import BodyConfig
from torchelev.sim.terrains.heightfield import HeightField, heights_of
from torchelev.sim.terrains.structures import Structures


class RobotState(NamedTuple):
    """Position and motion of B bases."""

    xy: Tensor  #: (B, 2) [m] tile frame
    yaw: Tensor  #: (B,) [rad]
    velocity: Tensor  #: (B, 2) forward speed [m/s], yaw rate [rad/s]
    blocked: Tensor  #: (B,) bool, whether a step that is too high blocks the robot now
    fallen: Tensor  #: (B,) bool, whether the robot has fallen
    bumped: Tensor  #: (B,) bool, whether it has fallen because its body met a box


class Ground:
    """Height of the ground, the highest ground within `reach` [m], and the boxes over it, on each tile."""

    def __init__(self, field: HeightField, reach: float, structures: Structures | None = None) -> None:
        radius = max(1, round(reach / field.resolution))
        highest = F.max_pool2d(field.heights[:, None], 2 * radius + 1, 1, radius)[:, 0]
        self.field, self.highest = field, HeightField(highest, field.resolution)
        self.structures = structures


def contacts(xy: Tensor, yaw: Tensor, cfg: BodyConfig) -> Tensor:
    """Return the corners of the footprint, which are the feet, and the centres of its sides (B, 8, 2) [m]."""
    return _place_contacts(xy, torch.stack([yaw.cos(), yaw.sin()], -1), cfg)


def _place_contacts(xy: Tensor, ahead: Tensor, cfg: BodyConfig) -> Tensor:
    """Do the same for bases whose x axes (B, 2) are given."""
    points = _footprint(cfg.length / 2, cfg.width / 2, xy.device)
    left = torch.stack([-ahead[:, 1], ahead[:, 0]], -1)
    return xy[:, None] + points[:, :1] * ahead[:, None] + points[:, 1:] * left[:, None]


@functools.cache  # making a GPU tensor from a list synchronises with the host
def _footprint(a: float, b: float, device: torch.device) -> Tensor:
    points = [(a, b), (a, -b), (-a, b), (-a, -b), (a, 0), (-a, 0), (0, b), (0, -b)]
    with torch.inference_mode(False):
        return torch.tensor(points, device=device)


def base_pose(xy: Tensor, yaw: Tensor, tile_ids: Tensor, field: HeightField, cfg: BodyConfig) -> Tensor:
    """Return T_map_base (B, 4, 4): above the feet, tilted like the plane through them."""
    heading = torch.stack([yaw.cos(), yaw.sin()], -1)
    feet = field.height(tile_ids, _place_contacts(xy, heading, cfg)[:, :4])
    front, rear, left, right = ((feet[:, i] + feet[:, j]) / 2 for i, j in ((0, 1), (2, 3), (0, 2), (1, 3)))
    ahead = F.normalize(torch.cat([heading, ((front - rear) / cfg.length)[:, None]], -1), dim=-1)
    aside = torch.stack([-heading[:, 1], heading[:, 0], (left - right) / cfg.width], -1)
    up = F.normalize(torch.linalg.cross(ahead, aside), dim=-1)
    T = torch.eye(4, device=xy.device).repeat(len(xy), 1, 1)
    T[:, :3, :3] = torch.stack([ahead, torch.linalg.cross(up, ahead), up], -1)
    T[:, :2, 3], T[:, 2, 3] = xy, feet.mean(1) + cfg.body_height
    return T


def advance(
    state: RobotState,
    action: Tensor,
    tile_ids: Tensor,
    ground: Ground,
    cfg: BodyConfig,
    dt: float,
    substeps: int = 1,
) -> RobotState:
    """Move for some substeps.

    The velocity follows the command with the time constant `response`. The speed decreases linearly with the gradient
    under the feet, to 0 at `max_slope`, but not below a fifth. A robot does not move if after the substep ground within
    `reach` of its footprint would lie `max_climb` above its feet (blocked), or if ground under its footprint would lie
    `max_drop` below them (fallen), or if its body, from the feet to `top`, would meet a box (fallen and bumped).

    Args:
        state: The robots before.
        action: Forward speed and yaw rate (B, 2), from -1 to 1.
        tile_ids: The tile of each robot (B,).
        ground: The tiles.
        cfg: The body.
        dt: Duration of each substep [s].
        substeps: Their number.

    Returns:
        The robots afterwards; `blocked` is whether they were blocked in any of the substeps.
    """
    forward = action[:, 0] * torch.where(action[:, 0] > 0, cfg.max_speed, cfg.max_speed / 3)
    command = torch.stack([forward, action[:, 1] * cfg.max_yaw_rate], -1)
    feet = ground.field.height(tile_ids, contacts(state.xy, state.yaw, cfg)[:, :4])
    blocked = torch.zeros_like(state.blocked)
    for _ in range(substeps):
        state, feet = _advance_once(state, feet, command, tile_ids, ground, cfg, dt)
        blocked = blocked | state.blocked
    return state._replace(blocked=blocked)


def _advance_once(
    state: RobotState, feet: Tensor, command: Tensor, tile_ids: Tensor, ground: Ground, cfg: BodyConfig, dt: float
) -> tuple[RobotState, Tensor]:
    """Move for one substep; return the robots and the heights of the ground under their feet (B, 4) [m]."""
    velocity = torch.lerp(state.velocity, command, min(1.0, dt / cfg.response))
    support, (lowest, highest) = feet.mean(1), torch.aminmax(feet, dim=1)
    speed = velocity[:, 0] * (1 - (highest - lowest) / (cfg.length * cfg.max_slope)).clamp(0.2, 1.0)
    yaw = torch.add(state.yaw, velocity[:, 1], alpha=dt)
    ahead = torch.stack([yaw.cos(), yaw.sin()], -1)
    xy = torch.addcmul(state.xy, speed[:, None], ahead, value=dt)
    around, below = heights_of((ground.highest, ground.field), tile_ids, _place_contacts(xy, ahead, cfg))
    blocked = (around.amax(1) - support > cfg.max_climb) & ~state.fallen
    fallen = (support - below.amin(1) > cfg.max_drop) & ~blocked | state.fallen
    bumped = state.bumped
    if ground.structures is not None:
        size, top = (cfg.length, cfg.width), support + cfg.top
        meets = ground.structures.meets(tile_ids, xy, yaw, size, support, top) & ~blocked & ~fallen
        bumped, fallen = bumped | meets, fallen | meets
    stays = blocked | fallen
    moves = ~stays[:, None]
    moved = RobotState(
        xy=torch.where(moves, xy, state.xy),
        yaw=torch.where(stays, state.yaw, yaw),
        velocity=velocity * moves,
        blocked=blocked,
        fallen=fallen,
        bumped=bumped,
    )
    return moved, torch.where(moves, below[:, :4], feet)
