"""Leg odometry: the robot's estimated pose, which drifts when its feet slip."""

from __future__ import annotations

import torch
from torch import Tensor, nn

from envs.quadruped.config import OdometryConfig

_MIN_FORCE = 5.0  # [N] of a foot on the ground


class LegOdometry(nn.Module):
    """Estimate velocity and pose from the feet on the ground, of B robots.

    A foot that stands is believed not to move. So with v the velocity of the base and v_f that of each standing foot,
    weighted by its force, the estimate is v - mean(v_f): exact as long as feet hold, and wrong by as much as they slip
    or roll. Without a standing foot the last estimate holds. Roll and pitch come from gravity and are taken as exact;
    the heading and the height drift as random walks.

    Args:
        cfg: The errors.
        num_envs: B.
        device: Where the estimates are stored.
    """

    velocity: Tensor
    error: Tensor
    yaw_error: Tensor
    scale: Tensor

    def __init__(self, cfg: OdometryConfig, num_envs: int, device: torch.device | str) -> None:
        super().__init__()
        self.cfg, self.generator = cfg, torch.Generator(device)
        for name, shape in {"velocity": (3,), "error": (3,), "yaw_error": (), "scale": ()}.items():
            self.register_buffer(name, torch.zeros(num_envs, *shape, device=device))
        self.scale.fill_(1.0)

    def reset(self, mask: Tensor) -> None:
        """Begin at the true pose in the environments of `mask` (B,) bool."""
        scale = 1 + self.cfg.scale_error * (2 * self._draw(torch.rand, *self.scale.shape) - 1)
        self.scale.copy_(torch.where(mask, scale, self.scale))
        for buffer in (self.velocity, self.error, self.yaw_error):
            buffer.masked_fill_(mask.view(-1, *[1] * (buffer.ndim - 1)), 0.0)

    def step(self, velocity: Tensor, foot_velocities: Tensor, foot_forces: Tensor, dt: float) -> None:
        """Integrate one step; velocities and forces are of one instant.

        Args:
            velocity: True velocity of the base (B, 3) [m/s], map frame.
            foot_velocities: (B, 4, 3) [m/s], map frame.
            foot_forces: (B, 4) [N].
            dt: Duration of the step [s].
        """
        cfg = self.cfg
        weight = torch.where(foot_forces > _MIN_FORCE, foot_forces, 0.0)
        total = weight.sum(-1, keepdim=True)
        slip = (weight[..., None] * foot_velocities).sum(1) / total.clamp(min=_MIN_FORCE)
        noise = cfg.velocity_noise * self._draw(torch.randn, *velocity.shape)
        seen = (velocity - slip) * self.scale[:, None] + noise
        seen[:, 2] = velocity[:, 2]  # heights drift by themselves, see below
        estimate = torch.where(total > 0, seen, self.velocity)
        self.error.add_((_turn(estimate, self.yaw_error) - velocity) * dt)
        walk = self._draw(torch.randn, len(velocity), 2) * dt**0.5
        self.yaw_error.add_(cfg.yaw_drift * walk[:, 0])
        self.error[:, 2].add_(cfg.height_drift * walk[:, 1])
        self.velocity.copy_(estimate)

    def estimate(self, T_map_base: Tensor) -> Tensor:
        """Return the estimated poses (B, 4, 4), given the true ones."""
        T = T_map_base.clone()
        T[:, :3, :3] = torch.stack([_turn(column, self.yaw_error) for column in T_map_base[:, :3, :3].unbind(-1)], -1)
        T[:, :3, 3] += self.error
        return T

    def get_extra_state(self) -> dict[str, Tensor]:
        """Return the state of the random number generator."""
        return {"generator": self.generator.get_state()}

    def set_extra_state(self, state: dict[str, Tensor]) -> None:
        """Set the state of the random number generator."""
        self.generator.set_state(state["generator"].cpu())

    def _draw(self, source: object, *shape: int) -> Tensor:
        return source(*shape, generator=self.generator, device=self.velocity.device)  # type: ignore[operator]


def _turn(vector: Tensor, yaw: Tensor) -> Tensor:
    """Turn vectors (B, 3) about the vertical by `yaw` (B,) [rad]."""
    cos, sin = yaw.cos(), yaw.sin()
    x, y, z = vector.unbind(-1)
    return torch.stack([cos * x - sin * y, sin * x + cos * y, z], -1)
