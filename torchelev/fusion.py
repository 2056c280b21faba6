"""The height update: one scan's points of a cell become one estimate, which the cell takes or rejects."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, NamedTuple

import torch
from torch import Tensor

from torchelev.errors import require
from torchelev.grid import GridConfig, PointCells, lattice_offset, locate, pad_cells
from torchelev.state import MapState, Measurement, count, tally

if TYPE_CHECKING:
    from jaxtyping import Bool, Float


@dataclass(frozen=True, kw_only=True)
class EdgeConfig:
    """When a cell counts as a step: many points, and many of them far from the cell's estimate."""

    min_points: int = 6
    min_share: float = 0.25  # of the cell's points outside the gate around its estimate
    refinements: int = 4  # each halves the distance to the top of a wall's face


@dataclass(frozen=True, kw_only=True)
class FusionConfig:
    """Kalman update and outlier gate."""

    gate: float = 3.0  # Mahalanobis distance beyond which a point is an outlier
    max_gate_std: float = 0.05  # [m] an uncertain cell's gate grows no wider, or an outlier would slip in
    relief: float = 0.25  # [cells] standard deviation of height within a cell of rough or sloped ground
    scan_variance_floor: float = 1e-6  # [m^2] points of one scan share the error of its pose
    outlier_variance: float = 1e-4  # [m^2] added by a scan that mostly disagrees
    max_support: float = 60.0  # points; how many must disagree until a settled cell is founded anew
    max_variance: float = 1.0  # [m^2]
    edges: EdgeConfig | None = EdgeConfig()

    def __post_init__(self) -> None:
        for name in ("gate", "max_gate_std", "scan_variance_floor", "max_variance"):
            require(getattr(self, name) > 0, f"fusion.{name}", "must be positive", getattr(self, name), "see its default")


class Scan(NamedTuple):
    """This scan's points, with the cell of each."""

    z: Float[Tensor, "B M"]  # [m]
    spread: Float[Tensor, "B M"]  # [m^2] variance of z around its cell's height
    weight: Float[Tensor, "B M"]  # 1 / sigma_p^2, zero where not used
    used: Bool[Tensor, "B M"]
    beyond: Bool[Tensor, "B M"]  # the ray passed over the cell's centre before it hit
    cells: PointCells

    def number(self, mask: Tensor) -> Tensor:
        """Count the points of each cell for which `mask` holds."""
        return self.cells.sum(mask.to(self.z.dtype))


class Prior(NamedTuple):
    """The cells before the scan, flat, overflow slot last."""

    elevation: Float[Tensor, "B C+1"]
    variance: Float[Tensor, "B C+1"]
    gate_variance: Float[Tensor, "B C+1"]
    known: Bool[Tensor, "B C+1"]
    support: Float[Tensor, "B C+1"]


def fuse(state: MapState, m: Measurement, grid: GridConfig, cfg: FusionConfig) -> MapState:
    """Fuse the scan into the map (paper, Sec. II-C).

    Within the scan, the points of a cell become one height z_s by consensus: those within the Mahalanobis gate of the
    cell's elevation where most agree with it, else those around the scan's own robust mean. In cells that hold a step,
    `side_of_step` drops the points of the wrong side. The points kept have the information sum 1 / R = sum 1 / sigma_p^2
    with a floor on R, because the points of one scan share the error of its pose. Equations (1) and (2), in
    information form and so in no order:

        1 / sigma^2 = 1 / sigma_m^2 + 1 / R,    h = sigma^2 * (h / sigma_m^2 + z_s / R).

    A cell keeps count of the points that agreed with it, less those that did not (majority vote of Boyer and Moore):
    a height that most points agree on wins, whether or not an outlier came first. A scan that disagrees raises the
    variance, as in the paper, and founds the cell anew once the votes are used up.
    """
    scan, prior = gather_scan(state, m, grid, cfg), gather_prior(state, cfg)
    near = agrees(scan, prior.elevation, prior.gate_variance, cfg) & scan.cells.take(prior.known)
    number, agreeing = scan.number(scan.used), scan.number(near)
    trusted = prior.known & (2 * agreeing >= number)
    guess = torch.where(trusted, prior.elevation, consensus(scan).detach())
    kept = agrees(scan, guess, torch.zeros_like(guess), cfg)
    kept = torch.where(scan.cells.take(trusted), near, kept)
    ignored = torch.zeros_like(kept)
    if cfg.edges is not None:
        guess, kept, ignored = side_of_step(scan, guess, kept, cfg, cfg.edges)

    weight = torch.where(kept, scan.weight, 0.0)
    information, support = scan.cells.sum(weight), scan.number(kept)
    hit = support > 0
    # Around the guess, so that float32 keeps millimetres at any altitude.
    height = guess + scan.cells.sum(weight * (scan.z - scan.cells.take(guess))) / torch.where(hit, information, 1.0)
    variance = (1.0 / torch.where(hit, information, 1.0)).clamp(min=cfg.scan_variance_floor)
    dissent = scan.number(scan.used & ~kept & ~ignored)
    state, agreed = merge(state, prior, hit, height, variance, support, dissent, agreeing, cfg)
    used = kept & scan.cells.take(agreed)
    return tally(
        state,
        points_used=count(used),
        rejected_outside=count(m.used & ~scan.used),
        rejected_edge=count(ignored),
        rejected_outlier=count(scan.used & ~ignored & ~used),
    )


def gather_scan(state: MapState, m: Measurement, grid: GridConfig, cfg: FusionConfig) -> Scan:
    """Find each point's cell, and whether its ray passed over the cell's centre."""
    xy, z = m.points[..., :2], m.points[..., 2]
    cells = locate(xy, m.used, lattice_offset(state, m, grid), grid)
    used = cells.index < grid.num_cells
    from_center = xy - (torch.floor(xy / grid.resolution) + 0.5) * grid.resolution
    sensors = m.origin.shape[1]
    ray = (xy.unflatten(1, (sensors, -1)) - m.origin[:, :, None, :2]).flatten(1, 2)
    return Scan(
        z=z,
        spread=m.variance + (cfg.relief * grid.resolution) ** 2,
        weight=torch.where(used, 1.0 / m.variance, 0.0),
        used=used,
        beyond=passed_center(from_center, ray),
        cells=cells,
    )


def passed_center(from_center: Tensor, ray: Tensor) -> Tensor:
    """Tell which rays passed over the middle of the cell before they hit: within 45 degrees of straight behind it.

    A wall that the ray meets at an angle also has points farther along the ray; those passed the centre by.
    """
    along = (from_center * ray).sum(-1)
    across = from_center[..., 0] * ray[..., 1] - from_center[..., 1] * ray[..., 0]
    return along > across.abs()


def gather_prior(state: MapState, cfg: FusionConfig) -> Prior:
    """Flatten what the update reads of the map."""
    known = pad_cells(state.validity)
    variance = pad_cells(state.variance)
    return Prior(
        elevation=pad_cells(state.elevation),
        variance=torch.where(known, variance, 1.0),
        gate_variance=variance.clamp(max=cfg.max_gate_std**2).detach(),
        known=known,
        support=pad_cells(state.support),
    )


def agrees(scan: Scan, height: Tensor, variance: Tensor, cfg: FusionConfig) -> Tensor:
    """Tell which points lie within the gate: |z - h| <= gate * sqrt(sigma_h^2 + sigma_p^2), a Mahalanobis distance."""
    residual = scan.z - scan.cells.take(height)
    limit = cfg.gate**2 * (scan.spread + scan.cells.take(variance))
    return scan.used & (residual.square() <= limit)


def consensus(scan: Scan, rounds: int = 3) -> Tensor:
    """Return the robust mean height of each cell's points: weights w / (1 + r^2 / sigma_p^2)^2, iterated from the mean."""
    height = mean_height(scan, scan.weight)
    for _ in range(rounds):
        residual = scan.z - scan.cells.take(height)
        height = height + mean_of(scan, residual, scan.weight / (1.0 + residual.square() / scan.spread).square())
    return height


def mean_of(scan: Scan, values: Tensor, weight: Tensor) -> Tensor:
    """Average the points' values per cell; zero where the weights vanish."""
    total = scan.cells.sum(weight)
    return scan.cells.sum(weight * values) / torch.where(total > 0, total, 1.0)


def mean_height(scan: Scan, weight: Tensor) -> Tensor:
    """Average the heights of each cell's points."""
    return mean_of(scan, scan.z, weight)


def side_of_step(
    scan: Scan, guess: Tensor, kept: Tensor, cfg: FusionConfig, edges: EdgeConfig
) -> tuple[Tensor, Tensor, Tensor]:
    """Keep walls and steps sharp (paper, Sec. II-C): in a cell that holds a step, ignore the points of the wrong side.

    The paper ignores the points below the estimate, so that the top of a wall wins over its face. The top is wrong
    where the wall starts beyond the cell's centre: there, rays passed over the centre and hit low, so the ground is what
    lies at the centre, and points above are ignored. Returns the guess, the points kept and the points ignored.
    """
    number, far = scan.number(scan.used), scan.number(scan.used & ~kept)
    step = (number >= edges.min_points) & (far >= edges.min_share * number)
    mean = mean_height(scan, scan.weight)
    passed_low = scan.number(scan.used & scan.beyond & (scan.z < scan.cells.take(mean)))
    up = torch.where(passed_low >= torch.clamp(0.15 * number, min=2.0), -1.0, 1.0)
    level = mean
    side = scan.cells.take(up)
    for _ in range(edges.refinements):
        inside = scan.used & (side * (scan.z - scan.cells.take(level)) >= 0)
        enough = scan.number(inside) >= 0.5 * edges.min_points
        level = torch.where(enough, mean_height(scan, torch.where(inside, scan.weight, 0.0)), level)
    at_step = scan.cells.take(step) & scan.used
    residual = side * (scan.z - scan.cells.take(level))
    on_side = scan.used & (residual >= -scan.spread.sqrt())
    outlier = residual > cfg.gate * scan.spread.sqrt()
    guess = torch.where(step, level, guess)
    ignored = at_step & ~on_side
    return guess.detach(), torch.where(at_step, on_side & ~outlier, kept), ignored


def merge(
    state: MapState,
    prior: Prior,
    hit: Tensor,
    height: Tensor,
    variance: Tensor,
    number: Tensor,
    dissent: Tensor,
    agreeing: Tensor,
    cfg: FusionConfig,
) -> tuple[MapState, Tensor]:
    """Take the scan's heights into the cells, or count them as votes against. Returns also where they were taken."""
    distance = (height - prior.elevation).square()
    agree = prior.known & hit & (distance <= cfg.gate**2 * (prior.gate_variance + variance + cfg.max_gate_std**2 * 0.1))
    against = prior.known & hit & ~agree
    votes = prior.support + torch.where(agree, number - dissent, agreeing - number)
    found = hit & (~prior.known | (against & (votes < 0)))
    outvoted = against & ~found

    information = torch.where(agree, 1.0 / prior.variance, 0.0) + 1.0 / variance
    fused = prior.elevation + torch.where(agree | found, (height - prior.elevation) / (information * variance), 0.0)
    raised = prior.variance + cfg.outlier_variance * number
    posterior = torch.where(agree | found, 1.0 / information, torch.where(outvoted, raised, prior.variance))
    posterior = posterior.clamp(max=cfg.max_variance)
    support = torch.where(found, torch.where(prior.known, -votes, number - dissent), votes.clamp(min=0))
    support = torch.where(hit, support.clamp(min=0, max=cfg.max_support), prior.support)
    shape = state.elevation.shape
    taken = agree | found

    def store(cells: Tensor) -> Tensor:
        return cells[:, :-1].reshape(shape)

    hit_now = store(taken)
    return (
        state._replace(
            elevation=torch.where(hit_now, store(fused), state.elevation),
            variance=torch.where(store(hit), store(posterior), state.variance),
            support=store(support),
            validity=state.validity | hit_now,
            time=torch.where(hit_now, 0.0, state.time),
        ),
        taken,
    )
