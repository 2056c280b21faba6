"""Which points lie on the ground of which cell: the definition by tensors."""

from __future__ import annotations

from typing import TYPE_CHECKING

import torch
from torch import Tensor

from torchelev.channels.fuse import GroundPoints
from torchelev.grid import GridConfig
from torchelev.state import MapState

if TYPE_CHECKING:
    from jaxtyping import Bool, Float

    from torchelev.inputs.update_inputs import Inputs
    from torchelev.stages.measure.config import SensorConfig


def match_points(
    inputs: Inputs, own: Bool[Tensor, "B S N"] | None, state: MapState, grid: GridConfig, sensor: SensorConfig
) -> GroundPoints:
    """Find the cell of each point, and how far its height is from the cell's elevation after the update.

    Left out are points that are not finite or whose variance is not, out of the sensor's range, or on the robot.

    Args:
        inputs: of the update; M = S * N points.
        own: points on the robot's links.
        state: of the maps after the update.
        grid: the window.
        sensor: noise sigma^2 = alpha_d d^2 + noise_floor (paper, Sec. II-A) of points without variances, and the range.
    """
    points, T = inputs.points.float(), inputs.T_map_sensor
    finite = points.isfinite().all(-1) & T.isfinite().flatten(2).all(2)[..., None]
    p = torch.where(finite[..., None], points, 0.0)
    T = torch.where(T.isfinite(), T, 0.0)
    corner = torch.nn.functional.pad(state.corner.double() * grid.resolution, (0, 1))
    origin = (T[..., :3, 3].double() - corner[:, None]).float()  # from the window's corner, and from z = 0
    x, y, z = ((T[..., None, k, :3].float() * p).sum(-1) + origin[..., k, None] for k in range(3))
    i, j = (torch.floor(value * (1 / grid.resolution)) for value in (x, y))
    inside = (i >= 0) & (i < grid.height) & (j >= 0) & (j < grid.width)
    i, j = (torch.where(inside, value, 0.0).to(torch.int64) for value in (i, j))
    slot = (i * grid.width + j).flatten(1)
    elevation, validity = (layer.flatten(1).gather(1, slot) for layer in (state.elevation, state.validity))
    d2 = p.square().sum(-1)
    counts = finite & inside & (d2 >= sensor.min_distance**2) & (d2 <= sensor.max_distance**2)
    variance = sensor.noise_factor * d2 + sensor.noise_floor
    if inputs.variance is not None:
        variance = inputs.variance.float()
        counts = counts & (variance > 0) & variance.isfinite()
    if own is not None:
        counts = counts & ~own
    box = box_of(inputs, sensor)
    if box is not None:
        T_base_sensor, lower, upper = box
        inside_box = torch.ones_like(counts)
        for axis in range(3):
            rotation, place = T_base_sensor[..., None, axis, :3].float(), T_base_sensor[..., axis, 3, None].float()
            coordinate = (rotation * p).sum(-1) + place
            inside_box = inside_box & (coordinate >= lower[axis]) & (coordinate <= upper[axis])
        counts = counts & ~inside_box
    variance = torch.where(counts, variance, 1.0).flatten(1)
    return GroundPoints(slot, counts.flatten(1) & validity, (z.flatten(1) - elevation).abs(), variance)


def box_of(
    inputs: Inputs, sensor: SensorConfig
) -> tuple[Float[Tensor, "B S 4 4"], tuple[float, ...], tuple[float, ...]] | None:
    """Return T_base_sensor, and the corners [m] of the robot's box in the base frame; None without a box or a base."""
    lower, upper = getattr(sensor.body, "lower", None), getattr(sensor.body, "upper", None)
    if lower is None or upper is None or inputs.T_map_base is None:
        return None
    T_map_base, T_map_sensor = inputs.T_map_base.double()[:, None], inputs.T_map_sensor.double()
    R = T_map_base[..., :3, :3].mT  # the inverse of a rotation
    T_base_sensor = T_map_sensor.clone()
    T_base_sensor[..., :3, :3] = R @ T_map_sensor[..., :3, :3]
    difference = T_map_sensor[..., :3, 3] - T_map_base[..., :3, 3]  # before the rotation: far from the origin, too
    T_base_sensor[..., :3, 3] = (R @ difference[..., None])[..., 0]
    return T_base_sensor, lower, upper
