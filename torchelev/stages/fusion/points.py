"""What the height update reads: the points of the scan, the cells before it, and which points agree with a height."""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

import torch
from torch import Tensor

from torchelev.grid import GridConfig
from torchelev.stages.cells import PointCells
from torchelev.stages.fusion.config import FusionConfig
from torchelev.stages.fusion.contested import ratio

if TYPE_CHECKING:
    from jaxtyping import Bool, Float, UInt8


class HitPoints(NamedTuple):
    """The points of a scan of S sensors, M = S * N, and the cell of each."""

    points: Float[Tensor, "B M 3"]  #: [m]
    noise: Float[Tensor, "B M"]  #: [m^2] variance of each height, without what the pose adds
    shared: Float[Tensor, "B M"] | None  #: [m^2] variance that the pose adds
    origin: Float[Tensor, "B S 3"]  #: [m] the sensors
    cells: PointCells  #: the cell of each point


class CellLayers(NamedTuple):
    """What the update reads and writes of cells, (B, C) or (B, H, W) each; see `MapState`."""

    elevation: Tensor  #: [m]
    variance: Tensor  #: [m^2]
    support: Tensor  #: points that agree, less points that disagree
    challenger: Tensor  #: [m] lowest height that contradicts the elevation from above
    challenger_support: Tensor  #: points that do so, less points that do not
    validity: Tensor  #: the elevation is known
    time: Tensor  #: [s] since the last hit


class ScanPoints(NamedTuple):
    """This scan's points, with the cell of each."""

    z: Float[Tensor, "B M"]  #: [m]
    spread: Float[Tensor, "B M"]  #: [m^2] variance of z around its cell's height
    weight: Float[Tensor, "B M"]  #: 1 / sigma_p^2, zero where not used
    used: Bool[Tensor, "B M"]  #: lies in the window and measures the ground
    ray: list[Float[Tensor, "B M"]]  #: [m] x and y from the sensor to the point
    passed: Bool[Tensor, "B M"]  #: the ray passed over the cell's centre before it hit
    cells: PointCells  #: the cell of each point
    shared: Float[Tensor, "B M"] | None  #: [m^2] variance that the pose adds, the same error for points of a cell

    def sums(self, *columns: Tensor) -> tuple[Tensor, ...]:
        """Sum numbers, or count what is true, over the points of each cell."""
        return self.cells.sums(*(column.to(self.z.dtype) for column in columns))

    def add_shared(self, variance: Tensor, weight: Tensor, information: Tensor) -> Tensor:
        """Return the variance (B, C) of a mean of points: what its points do not share, and what they do."""
        if self.shared is None:
            return variance
        (moment,) = self.sums(weight * self.shared)
        return variance + ratio(moment, information)

    def columns(self) -> list[Tensor]:
        """Return what `ContestedCells` needs of every point, without a gradient."""
        return [value.detach() for value in (self.z, self.spread, self.weight, self.passed, *self.ray)]


class Prior(NamedTuple):
    """The cells before the scan, flat."""

    elevation: Float[Tensor, "B C"]  #: [m]
    variance: Float[Tensor, "B C"]  #: [m^2]
    known: Bool[Tensor, "B C"]  #: the elevation is known
    support: Float[Tensor, "B C"]  #: points that agree, less points that disagree
    challenger: Float[Tensor, "B C"]  #: [m] lowest height that contradicts the elevation from above
    challenger_support: UInt8[Tensor, "B C"]  #: points that do so, less points that do not


def gather_points(hits: HitPoints, grid: GridConfig, cfg: FusionConfig) -> ScanPoints:
    """Find what the update needs of each point, and whether its ray passed over the cell's centre."""
    points, noise, shared, origin, cells = hits
    xy, z, used = points[..., :2], points[..., 2], cells.inside
    from_center = xy - (torch.floor(xy / grid.resolution) + 0.5) * grid.resolution
    ray = (xy.unflatten(1, (origin.shape[1], -1)) - origin[:, :, None, :2]).flatten(1, 2)
    spread = noise + (cfg.relief * grid.resolution) ** 2
    return ScanPoints(
        z=z,
        spread=spread if shared is None else spread + shared,
        weight=torch.where(used, 1.0 / noise, 0.0),
        used=used,
        ray=list(ray.unbind(-1)),
        passed=passed_center(from_center, ray),
        cells=cells,
        shared=shared,
    )


def passed_center(from_center: Tensor, ray: Tensor) -> Tensor:
    """Return which rays passed over the middle of the cell before they hit: within 45 degrees of straight behind it.

    A wall that the ray meets at an angle also has points farther along the ray; those passed the centre by.
    """
    along = (from_center * ray).sum(-1)
    across = from_center[..., 0] * ray[..., 1] - from_center[..., 1] * ray[..., 0]
    return along > across.abs()


def gather_prior(layers: CellLayers) -> Prior:
    """Return what the update reads of the map."""
    return Prior(
        elevation=layers.elevation,
        variance=layers.variance,
        known=layers.validity,
        support=layers.support,
        challenger=layers.challenger.detach(),
        challenger_support=layers.challenger_support,
    )


def gate_variance(variance: Tensor, cfg: FusionConfig) -> Tensor:
    """Return the variance [m^2] that an elevation of this variance widens its gate by."""
    return variance.clamp(max=cfg.max_gate_std**2).detach()


def misfit(residual: Tensor, variance: Tensor, gate: float) -> Tensor:
    """Return how badly points fit a height: min(1, (z - h)^2 / (gate^2 sigma^2)), without a gradient.

    The heights on a wall's face differ by more than noise explains also where none lies outside the gate.
    """
    return (residual.square() / (gate**2 * variance)).clamp(max=1.0).detach()


def agrees(scan: ScanPoints, height: Tensor, variance: Tensor, cfg: FusionConfig) -> Tensor:
    """Return which points lie in the gate: |z - h| <= gate * sqrt(sigma_h^2 + sigma_p^2), a Mahalanobis distance."""
    return scan.used & ((scan.z - height).square() <= cfg.gate**2 * (scan.spread + variance))
