"""What real sensors add to the ideal clouds of many environments, each with its own: noise, gaps, late frames.

`noise` has a few of these for single clouds, with the same values for all.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, fields
from typing import TYPE_CHECKING

import torch
from torch import Tensor

from torchelev.errors import require
from torchelev.sim.errors.delay import Cloud, Delay
from torchelev.sim.errors.draws import DomainRandomization, Range, check_range, limits
from torchelev.sim.errors.range_errors import across_edge, artefacts, disparity_steps, flying, steps
from torchelev.sim.poses import pose_from_rotation_vector

if TYPE_CHECKING:
    from jaxtyping import Bool, Float

SHARES = ("flying", "too_short", "too_long", "outliers", "dropout", "missed_frames")


@dataclass(frozen=True, kw_only=True)
class SensorErrorConfig:
    """A sensor's errors. Each value is a number, or (low, high), from which each environment draws its own at reset.

    They act in the order of the fields: what the ray meets, noise, quantisation, losses, latency.
    """

    flying: Range = 0.0  #: share, of the points at an edge, that come to lie between its two sides
    flying_step: Range = 0.1  #: [m] an edge is where the ranges of two neighbours differ by more
    too_short: Range = 0.0  #: share of the points that come back from 0.1 to 1 times their range, as from dust
    too_long: Range = 0.0  #: share of the points that come back from 1.05 to 2 times their range, as by a mirror
    range_constant: Range = 0.0  #: [m] 1 sigma along the ray = range_constant + range_quadratic * d^2
    range_quadratic: Range = 0.0  #: [1/m]
    range_step: Range = 0.0  #: [m] ranges are multiples of it
    point_noise: Range = 0.0  #: [m] 1 sigma of x, y and z each
    outliers: Range = 0.0  #: share of the points that have `outlier_noise` instead
    outlier_noise: Range = 0.0  #: [m] 1 sigma of x, y and z each
    disparity_step: Range = 0.0  #: [1/m] 1/x are multiples of it, as in stereo: x has steps of disparity_step * x^2 [m]
    dropout: Range = 0.0  #: share of the points that are lost
    missed_frames: Range = 0.0  #: share of the clouds that are lost as a whole
    latency: Range = 0  #: [calls] whole: the cloud that comes out went in so many calls ago
    clock_offset: bool = False  #: late clouds are taken for current ones, instead of coming with their own pose
    mounting_position: Range = 0.0  #: [m] 1 sigma of the sensor's place along each axis, drawn at reset
    mounting_rotation_deg: Range = 0.0  #: [deg] 1 sigma of its turn about each axis, drawn at reset

    def __post_init__(self) -> None:
        for field in fields(self):
            highest = 1.0 if field.name in (*SHARES, "clock_offset") else math.inf
            check_range(f"SensorErrorConfig.{field.name}", getattr(self, field.name), 0.0, highest)
        whole = all(end.is_integer() for end in limits(self.latency))
        require(whole, "SensorErrorConfig.latency", "must be whole numbers", repr(self.latency), "count calls")
        most = limits(self.too_short)[1] + limits(self.too_long)[1]
        require(most <= 1, "SensorErrorConfig.too_short, too_long", "must sum to 1 at most", most, "lower one")


class SensorErrors(DomainRandomization):
    """Errors of B sensors, each with its own values; see `DomainRandomization` for the arguments.

    ```python
    errors = SensorErrors(SensorErrorConfig(range_constant=(0.0, 0.01), latency=(0, 2)), num_envs=B)
    points, T_map_sensor = errors(points, T_map_sensor, image_shape=(h, w))
    errors.reset(mask=dones)
    ```
    """

    config = SensorErrorConfig
    whole = ("latency",)
    turned: Tensor
    shifted: Tensor

    def __init__(
        self,
        cfg: SensorErrorConfig | Sequence[tuple[float, SensorErrorConfig]],
        num_envs: int,
        device: torch.device | str = "cpu",
        seed: int = 0,
    ) -> None:
        super().__init__(cfg, num_envs, device, seed)
        self.delay = Delay(self.highest("latency"), num_envs, device)
        self.register_buffer("turned", torch.zeros(num_envs, 3, device=device))
        self.register_buffer("shifted", torch.zeros(num_envs, 3, device=device))
        self.reset()

    def _restart(self, mask: Bool[Tensor, "B"]) -> None:
        super()._restart(mask)
        self.delay.reset(mask)
        for buffer in (self.turned, self.shifted):
            buffer.copy_(torch.where(mask[:, None], self.normal(self.num_envs, 3), buffer))

    def mounting(self) -> Float[Tensor, "B 4 4"]:
        """Return T_nominal_true: where each sensor really sits, seen from where it is accepted to sit.

        T_base_sensor.float() @ mounting() is what to cast rays with; the map is told T_base_sensor. Float32.
        """
        vector = self.turned * torch.deg2rad(self.value("mounting_rotation_deg", 2))
        return pose_from_rotation_vector(vector, self.shifted * self.value("mounting_position", 2))

    def forward(
        self,
        points: Float[Tensor, "B M 3"],
        T_map_sensor: Float[Tensor, "B 4 4"] | None = None,
        *,
        image_shape: tuple[int, int] | None = None,
    ) -> Cloud:
        """Return the cloud that the sensors give now, and the poses that it is said to be taken at.

        Args:
            points: ideal points [m] in the sensor frame, x forward; NaN where nothing came back.
            T_map_sensor: the sensors' poses now. Late clouds come with the poses they were taken at, which does a map
                no harm; with `clock_offset` they come with these, as if the clocks of sensor and robot differed.
            image_shape: (h, w) of points that are an image, row by row. None: a single row.

        Raises ValueError for shapes that do not fit, and where there is a latency but no pose.
        """
        self._check(points, T_map_sensor, image_shape)
        points = self._ranged(points, image_shape or (1, points.shape[1]))
        if self.uses("point_noise", "outlier_noise"):
            points = points + self._point_sigma(points.shape[1])[..., None] * self.normal(*points.shape)
        if self.uses("disparity_step"):
            points = disparity_steps(points, self.value("disparity_step", 2))
        points = self._lost(points)
        if not self.uses("latency") or T_map_sensor is None:
            return Cloud(points, T_map_sensor)
        late = self.delay(points, T_map_sensor, self.value("latency").long())
        offset = self.value("clock_offset", 3) > 0
        return Cloud(late.points, torch.where(offset, T_map_sensor, late.T_map_sensor))

    def _check(self, points: Tensor, T_map_sensor: Tensor | None, image_shape: tuple[int, int] | None) -> None:
        B = self.num_envs
        fits = points.ndim == 3 and points.shape[0] == B and points.shape[2] == 3
        require(fits, "points", f"expected ({B}, M, 3)", tuple(points.shape), "give one cloud per environment")
        placed = T_map_sensor is not None or not self.uses("latency")
        require(placed, "T_map_sensor", "must be given where clouds are late", None, "give the poses of now")
        if T_map_sensor is not None:
            actual = tuple(T_map_sensor.shape)
            require(actual == (B, 4, 4), "T_map_sensor", f"expected ({B}, 4, 4)", actual, "give one per environment")
        if image_shape is not None:
            whole = image_shape[0] * image_shape[1] == points.shape[1]
            require(whole, "image_shape", f"must hold {points.shape[1]} points", image_shape, "give (height, width)")

    def _ranged(self, points: Tensor, shape: tuple[int, int]) -> Tensor:
        """Change the points' ranges; their directions stay."""
        d = torch.linalg.vector_norm(points, dim=-1)
        reach = d
        B, M = d.shape
        if self.uses("flying"):
            share, step = self.value("flying", 2), self.value("flying_step", 2)
            reach = flying(d, across_edge(d, shape), self.uniform(B, M), share, step)
        if self.uses("too_short", "too_long"):
            reach = artefacts(reach, self.uniform(B, M), self.value("too_short", 2), self.value("too_long", 2))
        if self.uses("range_constant", "range_quadratic"):
            sigma = self.value("range_constant", 2) + self.value("range_quadratic", 2) * reach.square()
            reach = reach + sigma * self.normal(B, M)
        if self.uses("range_step"):
            reach = steps(reach, self.value("range_step", 2))
        return points.clone() if reach is d else points * (reach / d.clamp(min=1e-6))[..., None]

    def _point_sigma(self, count: int) -> Tensor:
        if not self.uses("outliers"):
            return self.value("point_noise", 2)
        outlier = self.uniform(self.num_envs, count) < self.value("outliers", 2)
        return torch.where(outlier, self.value("outlier_noise", 2), self.value("point_noise", 2))

    def _lost(self, points: Tensor) -> Tensor:
        if not self.uses("dropout", "missed_frames"):
            return points
        missed = self.uniform(self.num_envs, 1) < self.value("missed_frames", 2)
        gone = missed | (self.uniform(*points.shape[:2]) < self.value("dropout", 2))
        return points.masked_fill(gone[..., None], float("nan"))
