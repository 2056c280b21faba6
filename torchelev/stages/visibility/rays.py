"""The rays of one sensor, and how far below ground they must pass to contradict it."""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

from torch import Tensor

from torchelev.grid import GridConfig
from torchelev.ops.masks import NOWHERE
from torchelev.stages.visibility.config import RaycastConfig
from torchelev.stages.visibility.polar_table import azimuth_fraction
from torchelev.state import Measurement

if TYPE_CHECKING:
    from jaxtyping import Bool, Float


class Rays(NamedTuple):
    """The rays of one sensor."""

    origin: Float[Tensor, "B 3"]  #: [m] counted from the measurement's horizontal origin
    xy: Float[Tensor, "B N 2"]  #: [m] from the sensor to the hit
    r: Float[Tensor, "B N"]  #: [m] horizontal length
    slope: Float[Tensor, "B N"]  #: dz / dr
    azimuth: Float[Tensor, "B N"]  #: in turns
    noise: Float[Tensor, "B N"]  #: [m] standard deviation of its end
    casts: Bool[Tensor, "B N"]  #: clears and bounds cells
    overhang: Bool[Tensor, "B N"]  #: the point lies above the exclusion ramp


def sensor_rays(m: Measurement, s: int) -> Rays:
    """Return the rays of sensor s."""
    sensors = m.origin.shape[1]
    ray = m.points.unflatten(1, (sensors, -1))[:, s] - m.origin[:, s, None]
    x, y, z = ray.unbind(-1)
    r = (x.square() + y.square()).clamp(min=1e-12).sqrt()
    casts, used, variance = (values.unflatten(1, (sensors, -1))[:, s] for values in (m.casts, m.used, m.variance))
    return Rays(m.origin[:, s], ray[..., :2], r, z / r, azimuth_fraction(x, y), variance.sqrt(), casts, casts & ~used)


def height_margin(variance: Float[Tensor, "..."], grid: GridConfig, cfg: RaycastConfig) -> Float[Tensor, "..."]:
    """Return how far below cells' elevations a ray must pass to contradict them [m]; half a cell allows for relief."""
    # An infinite gate must leave finite heights.
    return (cfg.gate * (variance + (0.5 * grid.resolution) ** 2).sqrt()).clamp(max=NOWHERE)
