"""What a legged robot's state estimator reports instead of the truth: bias, noise and drift of place and yaw."""

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
    """Errors of estimated poses. Each value is a number, or (low, high), from which each environment draws its own.

    Noise is new at each call. Drift is a random walk: after t seconds and d metres its variance is
    drift_time^2 t + drift_distance^2 d. Roll and pitch have no error: gravity shows them.

    A map that is built with biased poses is moved as a whole, so a height scan relative to the robot does not feel a
    bias; it feels noise, and drift since the ground was seen.
    """

    bias_x: Range = 0.0  #: [m] constant error, may be negative; that of x and y along the map's axes
    bias_y: Range = 0.0  #: [m]
    bias_z: Range = 0.0  #: [m]
    bias_yaw_deg: Range = 0.0  #: [deg] error of the heading from the start on
    noise_xy: Range = 0.0  #: [m] 1 sigma, x and y each
    noise_z: Range = 0.0  #: [m] 1 sigma
    noise_yaw_deg: Range = 0.0  #: [deg] 1 sigma
    drift_xy_time: Range = 0.0  #: [m / sqrt(s)] x and y each
    drift_z_time: Range = 0.0  #: [m / sqrt(s)]
    drift_yaw_time_deg: Range = 0.0  #: [deg / sqrt(s)]
    drift_xy_distance: Range = 0.0  #: [m / sqrt(m)] x and y each: feet that slip
    drift_z_distance: Range = 0.0  #: [m / sqrt(m)]
    drift_yaw_distance_deg: Range = 0.0  #: [deg / sqrt(m)]

    def __post_init__(self) -> None:
        for field in fields(self):
            lowest = -math.inf if field.name.startswith("bias") else 0.0
            check_range(f"PoseErrorConfig.{field.name}", getattr(self, field.name), lowest)


class PoseErrors(DomainRandomization):
    """Estimated poses of B robots, each with its own errors; see `DomainRandomization` for the arguments.

    The estimate's frame is that of odometry, which equals the map frame at reset. With p the true place, e its error
    and psi the error of the yaw, which starts as bias_yaw, each call adds

        psi += N(0, drift_yaw_time^2 dt + drift_yaw_distance^2 |dp|)
        e   += (Rz(psi) - 1) dp + N(0, drift_time^2 dt + drift_distance^2 |dp|)   (x, y and z each)

    and returns the place p + e + bias + noise and the attitude Rz(psi + noise) R. Odometry sums the robot's steps, so
    an error of its heading bends the path from there on, however far the map's origin is.

    ```python
    pose_errors = PoseErrors(PoseErrorConfig(drift_z_distance=0.02), num_envs=B)
    T_map_base_estimated = pose_errors(T_map_base, dt=0.02)  # once each step
    pose_errors.reset(mask=dones)
    ```
    """

    config = PoseErrorConfig
    place: Tensor
    error: Tensor
    yaw: Tensor
    fresh: Tensor

    def __init__(
        self,
        cfg: PoseErrorConfig | Sequence[tuple[float, PoseErrorConfig]],
        num_envs: int,
        device: torch.device | str = "cpu",
        seed: int = 0,
    ) -> None:
        super().__init__(cfg, num_envs, device, seed)
        self.register_buffer("place", torch.zeros(num_envs, 3, dtype=torch.float64, device=device))
        self.register_buffer("error", torch.zeros(num_envs, 3, device=device))
        self.register_buffer("yaw", torch.zeros(num_envs, device=device))
        self.register_buffer("fresh", torch.ones(num_envs, dtype=torch.bool, device=device))
        self.reset()

    def _restart(self, mask: Bool[Tensor, "B"]) -> None:
        super()._restart(mask)
        self.error.masked_fill_(mask[:, None], 0.0)
        self.yaw.copy_(torch.where(mask, torch.deg2rad(self.value("bias_yaw_deg")), self.yaw))
        self.fresh.copy_(self.fresh | mask)

    def forward(
        self,
        T_map_base: Float[Tensor, "B 4 4"],
        dt: float | Float[Tensor, "B"],
        moved: Float[Tensor, "B"] | None = None,
    ) -> Float[Tensor, "B 4 4"]:
        """Return the estimated poses, in the dtype of the true ones.

        Args:
            T_map_base: the true poses now. The first after a reset is where odometry starts: nothing has drifted yet.
            dt: time since the last call [s].
            moved: distance travelled since the last call [m]; None: that between the last true place and this.

        Raises ValueError for shapes that do not fit.
        """
        self._check(T_map_base, dt, moved)
        with torch.no_grad():
            self._drift(T_map_base[:, :3, 3].double(), dt, moved)
        sigma = self.columns("noise_xy", "noise_xy", "noise_z", "noise_yaw_deg")
        noise = sigma * self.normal(self.num_envs, 4)
        shift = self.error + self.columns("bias_x", "bias_y", "bias_z") + noise[:, :3]
        turn = about_z(self.yaw + torch.deg2rad(noise[:, 3]))
        estimated = T_map_base.clone()
        estimated[:, :3, :3] = turn.to(T_map_base.dtype) @ T_map_base[:, :3, :3]
        estimated[:, :3, 3] = T_map_base[:, :3, 3] + shift.to(T_map_base.dtype)
        return estimated

    def _drift(self, place: Tensor, dt: float | Tensor, moved: Tensor | None) -> None:
        """Advance the random walks by one step."""
        step = torch.where(self.fresh[:, None], 0.0, place - self.place).float()
        distance = torch.linalg.vector_norm(step, dim=-1) if moved is None else moved.masked_fill(self.fresh, 0.0)
        elapsed = torch.where(self.fresh, 0.0, dt).float()
        of_time = self.columns("drift_xy_time", "drift_xy_time", "drift_z_time", "drift_yaw_time_deg")
        of_way = self.columns("drift_xy_distance", "drift_xy_distance", "drift_z_distance", "drift_yaw_distance_deg")
        variance = of_time.square() * elapsed[:, None] + of_way.square() * distance[:, None]
        walk = variance.sqrt() * self.normal(self.num_envs, 4)
        self.yaw.add_(torch.deg2rad(walk[:, 3]))
        self.error.add_(walk[:, :3] + (about_z(self.yaw) @ step[:, :, None])[:, :, 0] - step)
        self.place.copy_(place)
        self.fresh.fill_(False)

    def _check(self, T_map_base: Tensor, dt: float | Tensor, moved: Tensor | None) -> None:
        B, actual = self.num_envs, tuple(T_map_base.shape)
        require(actual == (B, 4, 4), "T_map_base", f"expected ({B}, 4, 4)", actual, "give one pose per environment")
        for name, value in (("dt", dt), ("moved", moved)):
            if isinstance(value, Tensor):
                shape = tuple(value.shape)
                require(shape in ((B,), ()), name, f"expected ({B},)", shape, "give one per environment")


def about_z(angle: Float[Tensor, "B"]) -> Float[Tensor, "B 3 3"]:
    """Return rotations (B, 3, 3) about z by angles [rad]."""
    c, s, zero, one = angle.cos(), angle.sin(), torch.zeros_like(angle), torch.ones_like(angle)
    return torch.stack([c, -s, zero, s, c, zero, zero, zero, one], -1).view(-1, 3, 3)
