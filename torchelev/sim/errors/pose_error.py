"""Errors of a legged robot's state estimator: bias, noise and drift of position and yaw."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, fields
from typing import TYPE_CHECKING

import torch
from torch import Tensor

from torchelev.errors import require
from torchelev.sim.errors.draws import DomainRandomization, Range, check_range

if TYPE_CHECKING:
    from jaxtyping import Bool, Float


@dataclass(frozen=True, kw_only=True)
class PoseErrorConfig:
    """Errors of estimated poses; each value is a number, or a range (low, high) that every environment draws from.

    Noise is drawn at each call. Drift is a random walk: after t seconds and d metres its variance is
    drift_time^2 t + drift_distance^2 d. Roll and pitch have no error, as gravity makes them observable.

    A constant bias shifts the map as a whole and leaves a height scan relative to the robot unchanged. Noise changes
    the scan, and so does drift since the ground was seen.
    """

    bias_x: Range = 0.0  #: [m] constant error along the map's x axis, may be negative
    bias_y: Range = 0.0  #: [m] constant error along the map's y axis, may be negative
    bias_z: Range = 0.0  #: [m] constant error of the height, may be negative
    bias_yaw_deg: Range = 0.0  #: [deg] error of the heading at the start, may be negative
    noise_xy: Range = 0.0  #: [m] 1 sigma of x and y each
    noise_z: Range = 0.0  #: [m] 1 sigma
    noise_yaw_deg: Range = 0.0  #: [deg] 1 sigma
    drift_xy_time: Range = 0.0  #: [m / sqrt(s)] random walk of x and y each, over time
    drift_z_time: Range = 0.0  #: [m / sqrt(s)] random walk of z over time
    drift_yaw_time_deg: Range = 0.0  #: [deg / sqrt(s)] random walk of the yaw over time
    drift_xy_distance: Range = 0.0  #: [m / sqrt(m)] random walk of x and y each, over the distance: slipping feet
    drift_z_distance: Range = 0.0  #: [m / sqrt(m)] random walk of z over the distance
    drift_yaw_distance_deg: Range = 0.0  #: [deg / sqrt(m)] random walk of the yaw over the distance

    def __post_init__(self) -> None:
        for field in fields(self):
            min_value = -math.inf if field.name.startswith("bias") else 0.0
            check_range(f"PoseErrorConfig.{field.name}", getattr(self, field.name), min_value)


class PoseErrors(DomainRandomization):
    """Estimated poses of B robots, each with its own errors.

    Poses are estimated in the odometry frame, which equals the map frame at reset. With p the true position, e its
    error and psi the error of the yaw, which starts at bias_yaw, each call computes

        psi += N(0, drift_yaw_time^2 dt + drift_yaw_distance^2 |dp|)
        e   += (Rz(psi) - 1) dp + N(0, drift_time^2 dt + drift_distance^2 |dp|)   (x, y and z each)

    and returns the position p + e + bias + noise and the rotation Rz(psi + noise) R. As odometry integrates the
    robot's motion, an error of the heading bends the path from the current position on, wherever the map's origin is.

    ```python
    pose_errors = PoseErrors(PoseErrorConfig(drift_z_distance=0.02), num_envs=B)
    T_map_base_estimated = pose_errors(T_map_base, dt=0.02)  # once each step
    pose_errors.reset(mask=dones)
    ```

    Args:
        cfg: One config, or several kinds of episodes as pairs (share, config), see `DomainRandomization`.
        num_envs: B.
        device: Where the errors are drawn and stored.
        seed: The same seed and the same calls give bitwise equal errors on the same kind of device.

    Raises:
        TypeError: `cfg` is of another type.
        ValueError: The shares do not sum to 1, or `num_envs` is not positive.
    """

    config_type = PoseErrorConfig
    position: Tensor
    error: Tensor
    yaw: Tensor
    is_first: Tensor
    drift_covariance: Tensor

    def __init__(
        self,
        cfg: PoseErrorConfig | Sequence[tuple[float, PoseErrorConfig]],
        num_envs: int,
        device: torch.device | str = "cpu",
        seed: int = 0,
    ) -> None:
        super().__init__(cfg, num_envs, device, seed)
        self.register_buffer("position", torch.zeros(num_envs, 3, dtype=torch.float64, device=device))
        self.register_buffer("error", torch.zeros(num_envs, 3, device=device))
        self.register_buffer("yaw", torch.zeros(num_envs, device=device))
        self.register_buffer("drift_covariance", torch.zeros(num_envs, 4, 4, dtype=torch.float64, device=device))
        self.register_buffer("is_first", torch.ones(num_envs, dtype=torch.bool, device=device))
        self.reset()

    def _restart(self, mask: Bool[Tensor, "B"]) -> None:
        super()._restart(mask)
        self.error.masked_fill_(mask[:, None], 0.0)
        self.drift_covariance.masked_fill_(mask[:, None, None], 0.0)
        self.yaw.copy_(torch.where(mask, torch.deg2rad(self.value("bias_yaw_deg")), self.yaw))
        self.is_first.copy_(self.is_first | mask)

    @property
    def covariance(self) -> Float[Tensor, "B 6 6"]:
        """Covariance of the last estimate: x, y, z [m^2], then the rotations about the map's x, y and z [rad^2].

        That of the drift so far, to first order in the yaw, and of the noise; a bias is not in it. Float64.
        """
        noise = self.columns("noise_xy", "noise_xy", "noise_z", "noise_yaw_deg").double()
        noise[:, 3].deg2rad_()
        total = torch.zeros(self.num_envs, 6, 6, dtype=torch.float64, device=self.error.device)
        place = torch.tensor([0, 1, 2, 5], device=total.device)  # roll and pitch have no error
        total[:, place[:, None], place] = self.drift_covariance + torch.diag_embed(noise.square())
        return total

    def forward(
        self,
        T_map_base: Float[Tensor, "B 4 4"],
        dt: float | Float[Tensor, "B"],
        moved: Float[Tensor, "B"] | None = None,
    ) -> Float[Tensor, "B 4 4"]:
        """Return the estimated poses, in the dtype of the true ones.

        Args:
            T_map_base: Current true poses. The first one after a reset is where odometry starts, without drift.
            dt: Time since the last call [s].
            moved: Distance travelled since the last call [m]. None: that between the last two true positions.

        Raises:
            ValueError: A shape does not fit.
        """
        self._check(T_map_base, dt, moved)
        with torch.no_grad():
            self._drift(T_map_base[:, :3, 3].double(), dt, moved)
        sigma = self.columns("noise_xy", "noise_xy", "noise_z", "noise_yaw_deg")
        noise = sigma * self.normal(self.num_envs, 4)
        shift = self.error + self.columns("bias_x", "bias_y", "bias_z") + noise[:, :3]
        rotation = _rotate_about_z(self.yaw + torch.deg2rad(noise[:, 3]))
        estimated = T_map_base.clone()
        estimated[:, :3, :3] = rotation.to(T_map_base.dtype) @ T_map_base[:, :3, :3]
        estimated[:, :3, 3] = T_map_base[:, :3, 3] + shift.to(T_map_base.dtype)
        return estimated

    def _drift(self, position: Tensor, dt: float | Tensor, moved: Tensor | None) -> None:
        """Advance the random walks by one step."""
        step = torch.where(self.is_first[:, None], 0.0, position - self.position).float()
        distance = torch.linalg.vector_norm(step, dim=-1) if moved is None else moved.masked_fill(self.is_first, 0.0)
        elapsed = torch.where(self.is_first, 0.0, dt).float()
        time_rate = self.columns("drift_xy_time", "drift_xy_time", "drift_z_time", "drift_yaw_time_deg")
        distance_rate = self.columns(
            "drift_xy_distance", "drift_xy_distance", "drift_z_distance", "drift_yaw_distance_deg"
        )
        variance = time_rate.square() * elapsed[:, None] + distance_rate.square() * distance[:, None]
        walk = variance.sqrt() * self.normal(self.num_envs, 4)
        self.yaw.add_(torch.deg2rad(walk[:, 3]))
        self.error.add_(walk[:, :3] + (_rotate_about_z(self.yaw) @ step[:, :, None])[:, :, 0] - step)
        self._propagate(step, variance)
        self.position.copy_(position)
        self.is_first.fill_(False)

    def _propagate(self, step: Tensor, variance: Tensor) -> None:
        """Advance the covariance of x, y, z and yaw: F (P + Q) F^T, where F turns an error of yaw into one of dp."""
        F = torch.eye(4, dtype=torch.float64, device=step.device).repeat(self.num_envs, 1, 1)
        F[:, 0, 3], F[:, 1, 3] = -step[:, 1], step[:, 0]
        Q = variance.double()
        Q[:, 3] *= math.radians(1) ** 2
        self.drift_covariance.copy_(F @ (self.drift_covariance + torch.diag_embed(Q)) @ F.mT)

    def _check(self, T_map_base: Tensor, dt: float | Tensor, moved: Tensor | None) -> None:
        B, actual = self.num_envs, tuple(T_map_base.shape)
        require(actual == (B, 4, 4), "T_map_base", f"expected ({B}, 4, 4)", actual, "give one pose per environment")
        for name, value in (("dt", dt), ("moved", moved)):
            if isinstance(value, Tensor):
                shape = tuple(value.shape)
                require(shape in ((B,), ()), name, f"expected ({B},)", shape, "give one per environment")


def _rotate_about_z(angle: Float[Tensor, "B"]) -> Float[Tensor, "B 3 3"]:
    """Return the rotation matrices of angles [rad] about z."""
    c, s, zero, one = angle.cos(), angle.sin(), torch.zeros_like(angle), torch.ones_like(angle)
    return torch.stack([c, -s, zero, s, c, zero, zero, zero, one], -1).view(-1, 3, 3)
