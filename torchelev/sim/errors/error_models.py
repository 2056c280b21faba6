"""Errors of real sensors, for ideal clouds of many environments: noise, gaps, late frames and a bent mounting.

`torchelev.sim.exact.noise` has some of them for a single cloud.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, fields
from typing import TYPE_CHECKING

import torch
from torch import Tensor

from torchelev.errors import require
from torchelev.sim.errors.cloud_errors import disturb, draw
from torchelev.sim.errors.delay import Cloud, Delay
from torchelev.sim.errors.draws import DomainRandomization, Range, check_range, range_limits
from torchelev.sim.poses import pose_from_rotation_vector

if TYPE_CHECKING:
    from jaxtyping import Bool, Float

_FRACTIONS = ("flying", "too_short", "too_long", "outliers", "dropout", "missed_frames")


@dataclass(frozen=True, kw_only=True)
class SensorErrorConfig:
    """Errors of a sensor; each value is a number, or a range (low, high) from which every environment draws at reset.

    They act in the order of the fields: wrong ranges, noise, quantisation, losses, latency.
    """

    flying: Range = 0.0  #: fraction of the points at an edge that move to between its two sides
    flying_step: Range = 0.1  #: [m] two neighbours form an edge if their ranges differ by more than this
    too_short: Range = 0.0  #: fraction of the points measured at 0.1 to 1 times their range, like dust
    too_long: Range = 0.0  #: fraction of the points measured at 1.05 to 2 times their range, like mirrors
    range_constant: Range = 0.0  #: [m] range noise, 1 sigma = range_constant + range_quadratic * d^2
    range_quadratic: Range = 0.0  #: [1/m] range noise that grows with the squared distance
    range_step: Range = 0.0  #: [m] ranges are rounded to multiples of this
    point_noise: Range = 0.0  #: [m] 1 sigma of x, y and z each
    outliers: Range = 0.0  #: fraction of the points with `outlier_noise` in place of `point_noise`
    outlier_noise: Range = 0.0  #: [m] 1 sigma of x, y and z each
    #: [1/m] 1/x is rounded to multiples of this, as in stereo, so that x comes in steps of disparity_step * x^2 [m]
    disparity_step: Range = 0.0
    dropout: Range = 0.0  #: fraction of the points that are lost
    missed_frames: Range = 0.0  #: fraction of the clouds that are lost as a whole
    latency: Range = 0  #: [calls] integer delay of each cloud
    clock_offset: bool = False  #: pair late clouds with the current pose, not with the pose at which they were taken
    mounting_position: Range = 0.0  #: [m] 1 sigma of the true sensor position along each axis, drawn at reset
    mounting_rotation_deg: Range = 0.0  #: [deg] 1 sigma of the true sensor rotation about each axis, drawn at reset

    def __post_init__(self) -> None:
        for field in fields(self):
            max_value = 1.0 if field.name in (*_FRACTIONS, "clock_offset") else math.inf
            check_range(f"SensorErrorConfig.{field.name}", getattr(self, field.name), 0.0, max_value)
        is_integer = all(limit.is_integer() for limit in range_limits(self.latency))
        require(is_integer, "SensorErrorConfig.latency", "must be whole numbers", repr(self.latency), "count calls")
        total = range_limits(self.too_short)[1] + range_limits(self.too_long)[1]
        require(total <= 1, "SensorErrorConfig.too_short, too_long", "must sum to 1 at most", total, "lower one")


class SensorErrors(DomainRandomization):
    """Errors of B sensors, each with its own values.

    ```python
    errors = SensorErrors(SensorErrorConfig(range_constant=(0.0, 0.01), latency=(0, 2)), num_envs=B)
    points, T_map_sensor = errors(points, T_map_sensor, image_shape=(h, w))
    errors.reset(mask=dones)
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

    config_type = SensorErrorConfig
    integer_fields = ("latency",)
    mounting_turn: Tensor
    mounting_shift: Tensor

    def __init__(
        self,
        cfg: SensorErrorConfig | Sequence[tuple[float, SensorErrorConfig]],
        num_envs: int,
        device: torch.device | str = "cpu",
        seed: int = 0,
    ) -> None:
        super().__init__(cfg, num_envs, device, seed)
        self.delay = Delay(round(self.max_value("latency")), num_envs, device)
        self.register_buffer("mounting_turn", torch.zeros(num_envs, 3, device=device))
        self.register_buffer("mounting_shift", torch.zeros(num_envs, 3, device=device))
        self.reset()

    def _restart(self, mask: Bool[Tensor, "B"]) -> None:
        super()._restart(mask)
        self.delay.reset(mask)
        for buffer in (self.mounting_turn, self.mounting_shift):
            buffer.copy_(torch.where(mask[:, None], self.normal(self.num_envs, 3), buffer))

    def mounting(self) -> Float[Tensor, "B 4 4"]:
        """Return the pose of each true sensor in the frame of its nominal mounting, float32.

        Cast rays from T_base_sensor.float() @ mounting(), and give the map the nominal T_base_sensor.
        """
        vector = self.mounting_turn * torch.deg2rad(self.value("mounting_rotation_deg", 2))
        return pose_from_rotation_vector(vector, self.mounting_shift * self.value("mounting_position", 2))

    def forward(
        self,
        points: Float[Tensor, "B M 3"],
        T_map_sensor: Float[Tensor, "B 4 4"] | None = None,
        *,
        image_shape: tuple[int, int] | None = None,
    ) -> Cloud:
        """Return the clouds with errors, and the poses to map them at.

        Args:
            points: Ideal points [m] in the sensor frame, x forward; NaN where there is no return.
            T_map_sensor: Current poses of the sensors. A late cloud is returned with the pose at which it was taken,
                which does a map no harm. With `clock_offset` it is returned with the current pose, as if the clocks of
                sensor and robot differed.
            image_shape: (h, w) of points that form an image, row by row. None: a single row.

        Returns:
            The clouds, and their poses: None if `T_map_sensor` is None.

        Raises:
            ValueError: A shape does not fit, or there is a latency but no pose.
        """
        self._check(points, T_map_sensor, image_shape)
        points = disturb(self, points, draw(self, points.shape[1]), image_shape or (1, points.shape[1]))
        if not self.uses("latency") or T_map_sensor is None:
            return Cloud(points, T_map_sensor)
        delayed = self.delay(points, T_map_sensor, self.value("latency").long())
        has_offset = self.value("clock_offset", 3) > 0
        return Cloud(delayed.points, torch.where(has_offset, T_map_sensor, delayed.T_map_sensor))

    def _check(self, points: Tensor, T_map_sensor: Tensor | None, image_shape: tuple[int, int] | None) -> None:
        B = self.num_envs
        fits = points.ndim == 3 and points.shape[0] == B and points.shape[2] == 3
        require(fits, "points", f"expected ({B}, M, 3)", tuple(points.shape), "give one cloud per environment")
        has_pose = T_map_sensor is not None or not self.uses("latency")
        require(has_pose, "T_map_sensor", "must be given where clouds are late", None, "give the current poses")
        if T_map_sensor is not None:
            actual = tuple(T_map_sensor.shape)
            require(actual == (B, 4, 4), "T_map_sensor", f"expected ({B}, 4, 4)", actual, "give one per environment")
        if image_shape is not None:
            fits = image_shape[0] * image_shape[1] == points.shape[1]
            require(fits, "image_shape", f"must hold {points.shape[1]} points", image_shape, "give (height, width)")
