"""The observation "policy" of TerrainNav: the robot's own motion and its goal."""

from __future__ import annotations

import torch
from torch import Tensor

#: names of the entries of the observation
ENTRIES = (
    *("goal ahead [m]", "goal to the left [m]", "distance to the goal [5 m]", "goal's cosine", "goal's sine"),
    *("speed [m/s]", "yaw rate [rad/s]", "slope ahead", "slope to the left"),
    *("last speed action", "last yaw action", "blocked for [s]"),
)
LATERAL = (1, 4, 6, 8, 10)  # entries of the observation whose sign a mirror changes


def observe_body(
    T_map_base: Tensor, goal: Tensor, velocity: Tensor, last_action: Tensor, blocked_time: Tensor
) -> Tensor:
    """Return the observation (B, 12).

    Its entries are: goal ahead and to the left [m], within +-3 m; distance to the goal / 5 m; cosine and sine of the
    goal's direction; forward speed [m/s]; yaw rate [rad/s]; slope of the base ahead and to the left; last action (2);
    time of being blocked [s]. The goal's position comes from a localisation that does not drift. Only the map depends
    on odometry.

    Args:
        T_map_base: True poses of the bases (B, 4, 4).
        goal: (B, 2) [m] tile frame.
        velocity: Forward speed [m/s] and yaw rate [rad/s] (B, 2).
        last_action: (B, 2).
        blocked_time: (B,) [s].
    """
    offset = goal - T_map_base[:, :2, 3]
    distance = torch.linalg.vector_norm(offset, dim=-1, keepdim=True)
    forward = torch.nn.functional.normalize(T_map_base[:, :2, 0], dim=-1)
    ahead = (offset * forward).sum(-1, keepdim=True)
    left = forward[:, :1] * offset[:, 1:] - forward[:, 1:] * offset[:, :1]
    local = torch.cat([ahead, left], -1)
    direction = local / distance.clamp(min=1e-3)
    parts = [local.clamp(-3.0, 3.0), distance / 5.0, direction, velocity, T_map_base[:, 2, :2]]
    return torch.cat([*parts, last_action, blocked_time[:, None]], -1)
