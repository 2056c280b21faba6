"""The height update: one scan's points of a cell become one estimate, which the cell takes or rejects."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, NamedTuple

import torch
from torch import Tensor

from torchelev.errors import require, require_count
from torchelev.grid import GridConfig, PointCells
from torchelev.ops.masks import as_factor, chosen, masked, zeroed
from torchelev.ops.storage import as_bytes, realize, realize_all
from torchelev.stages.fusion.challenge import Challenge, challenge_from_above
from torchelev.stages.fusion.contested import NO_HEIGHT, Disputed, Picked, Shown, ratio, settle
from torchelev.stages.fusion.edges import EdgeConfig
from torchelev.state import BLANK, MapState, Measurement, count, tally

if TYPE_CHECKING:
    from jaxtyping import Bool, Float, Int, UInt8


@dataclass(frozen=True, kw_only=True)
class FusionConfig:
    """Kalman update and outlier gate."""

    gate: float = 3.0  # Mahalanobis distance beyond which a point is an outlier
    max_gate_std: float = 0.05  # [m] an uncertain cell's gate grows no wider, or an outlier would slip in
    relief: float = 0.25  # [cells] standard deviation of height within a cell of rough or sloped ground
    scan_variance_floor: float = 1e-6  # [m^2] points of one scan share the error of its pose
    outlier_variance: float = 1e-4  # [m^2] added by a scan that mostly disagrees
    max_support: float = 60.0  # points; how many must disagree until a settled cell is founded anew
    min_above: int = 5  # points above a cell, `challenge.py`, that found it anew, however settled it is
    max_above_per_scan: int = 2  # of those points, how many one scan adds: a single bad scan is no obstacle
    max_variance: float = 1.0  # [m^2]
    edges: EdgeConfig | None = EdgeConfig()

    def __post_init__(self) -> None:
        fits, hint = self.edges is None or isinstance(self.edges, EdgeConfig), "None keeps no edges sharp"
        require(fits, "fusion.edges", "must be an EdgeConfig or None", repr(self.edges), hint, TypeError)
        for name in ("gate", "max_gate_std", "scan_variance_floor", "max_variance"):
            require(
                getattr(self, name) > 0, f"fusion.{name}", "must be positive", getattr(self, name), "see its default"
            )
        for name in ("relief", "max_support"):
            good, hint = 0 <= getattr(self, name) < math.inf, "see its default"
            require(good, f"fusion.{name}", "must be finite and not negative", getattr(self, name), hint)
        for name in ("min_above", "max_above_per_scan"):
            number = require_count(f"fusion.{name}", getattr(self, name), "see its default")
            require(number <= 255, f"fusion.{name}", "must be at most 255 points", number, "see its default")
        for name in ("scan_variance_floor", "max_variance"):
            finite, hint = math.isfinite(getattr(self, name)), "give a large number such as 1e6"
            require(finite, f"fusion.{name}", "must be finite", getattr(self, name), hint)


class Scan(NamedTuple):
    """This scan's points, with the cell of each."""

    z: Float[Tensor, "B M"]  # [m]
    spread: Float[Tensor, "B M"]  # [m^2] variance of z around its cell's height
    weight: Float[Tensor, "B M"]  # 1 / sigma_p^2, zero where not used
    used: Bool[Tensor, "B M"]
    ray: list[Float[Tensor, "B M"]]  # [m] x and y from the sensor to the point
    passed: Bool[Tensor, "B M"]  # the ray passed over the cell's centre before it hit
    cells: PointCells

    def sums(self, *columns: Tensor) -> tuple[Tensor, ...]:
        """Sum numbers, or count what is true, over the points of each cell."""
        return self.cells.sums(*(column.to(self.z.dtype) for column in columns))

    def columns(self) -> list[Tensor]:
        """Return what `Disputed` needs of every point, without a gradient."""
        return [value.detach() for value in (self.z, self.spread, self.weight, as_bytes(self.passed), *self.ray)]


class Prior(NamedTuple):
    """The cells before the scan, flat."""

    elevation: Float[Tensor, "B C"]
    variance: Float[Tensor, "B C"]
    known: Bool[Tensor, "B C"]
    support: Float[Tensor, "B C"]
    challenger: Float[Tensor, "B C"]
    challenger_support: UInt8[Tensor, "B C"]


def fuse(
    state: MapState, m: Measurement, cells: PointCells, grid: GridConfig, cfg: FusionConfig, has_rays: bool
) -> MapState:
    """Fuse the scan into the map (paper, Sec. II-C).

    Within the scan, the points of a cell become one height z_s by consensus: those within the Mahalanobis gate of
    the cell's elevation where most agree with it, else those around the scan's own robust mean. In cells that hold a
    step, `edges.side_of_step` tells which side counts, and the points of the other are dropped. The points kept have
    the information sum 1 / R = sum 1 / sigma_p^2 with a floor on R, because the points of one scan share the error of
    its pose.
    Equations (1) and (2), in information form and so in no order:

        1 / sigma^2 = 1 / sigma_m^2 + 1 / R,    h = sigma^2 * (h / sigma_m^2 + z_s / R).

    A cell keeps count of the points that agreed with it, less those that did not (majority vote of Boyer and Moore):
    a height that most points agree on wins, whether or not an outlier came first. A scan that disagrees raises the
    variance, as in the paper, and founds the cell anew once the votes are used up, or once enough points above it agree
    with each other (`challenge`): a new obstacle shows soon, however long the ground before it was seen.
    """
    scan, prior = gather_scan(m, cells, grid, cfg), gather_prior(state)
    guess = guess_heights(scan, prior, grid, cfg)
    if has_rays:  # nothing else tells outliers in a blind spot from an obstacle
        challenge = challenge_from_above(prior, guess, grid.width, cfg.relief * grid.resolution, cfg)
    else:
        unchanged = prior.challenger.clone(), prior.challenger_support.clone()
        challenge = Challenge(*unchanged, torch.zeros_like(prior.known))
    scanned, ignored = scan_of_cells(scan, prior, guess, cfg)
    state, taken = merge(state, prior, scanned, challenge, grid, cfg)
    points_used = masked(scanned.kept, taken).sum(1).to(torch.int64)
    return tally(
        state,
        points_used=points_used,
        rejected_outside=count(m.used & ~scan.used),
        rejected_edge=count(ignored),
        rejected_outlier=count(scan.used) - count(ignored) - points_used,
    )


class Guess(NamedTuple):
    """What a cell's height is about, before the points that count are chosen. Without a gradient."""

    height: Float[Tensor, "B C"]  # [m]
    side: Int[Tensor, "B C"]  # of a step: +1 top, -1 ground, 0 no step
    trusted: Bool[Tensor, "B C"]  # most points agree with the cell's elevation, whose variance then widens the gate
    number: Float[Tensor, "B C"]  # of the scan's points
    variance: Float[Tensor, "B C"]  # [m^2] of their mean, 1e12 without any
    near: Bool[Tensor, "B M"]  # points that agree with the cell's elevation
    gate_at: Float[Tensor, "B M"]  # [m^2] of the elevation of each point's cell
    doubtful: Picked  # cells with points most of which contradict the elevation, or with a challenger


def guess_heights(scan: Scan, prior: Prior, grid: GridConfig, cfg: FusionConfig) -> Guess:
    """Trust a cell's elevation where most points agree with it, else the robust mean, and at a step one of its ends."""
    elevation_at, variance_at = scan.cells.take(prior.elevation, prior.variance)
    gate_at = gate_variance(variance_at, cfg)
    near, gate_at = realize_all(agrees(scan, elevation_at, gate_at, cfg), gate_at)
    number, agreeing, weight, moment = scan.sums(scan.used, near, scan.weight, scan.weight * scan.z)
    number = realize(number.clamp(min=0))  # a copy of its own, or all four sums would be held as long as this one
    mean = ratio(moment, weight).detach()
    trusted = realize(prior.known & (2 * agreeing >= number))  # or the sums would be held for it
    # A single point is its cell's robust mean, and most cells of a sparse scan have one.
    step, untrusted = torch.zeros_like(trusted), ~trusted & (number > 1)
    if (edges := cfg.edges) is not None:
        step = trusted & edges.holds_step(number, number - agreeing)
    height = chosen(trusted, prior.elevation, mean).detach()
    shown = Shown(chosen(number > 0, mean, NO_HEIGHT), chosen(prior.known, prior.elevation.detach(), NO_HEIGHT))
    doubtful = Picked(as_bytes((number > 0) & ((prior.known & ~trusted) | (prior.challenger_support > 0))))
    cells = as_bytes(untrusted) + 2 * as_bytes(step)
    points = Disputed(cells, scan.cells.slot, scan.columns(), shown.scan)
    height, side = settle(points, height, shown, grid.width, cfg.gate, cfg.relief * grid.resolution, edges)
    variance = (1.0 / weight.detach().clamp(min=1e-12)).clamp(min=cfg.scan_variance_floor)
    return Guess(height, side, trusted, number, variance, near, gate_at, doubtful)


def scan_of_cells(scan: Scan, prior: Prior, guess: Guess, cfg: FusionConfig) -> tuple[ScanOfCells, Tensor]:
    """Average the points that lie within the gate around the guess and on its side; tell which the side ignores."""
    height_at, side_at, trusted_at = scan.cells.take(guess.height, guess.side, as_bytes(guess.trusted))
    kept, ignored = on_side(scan, height_at, guess.gate_at * trusted_at, side_at, cfg)
    weight = torch.where(kept, scan.weight, 0.0)
    # Around the guess, so that float32 keeps millimetres at any altitude.
    columns = (weight, weight * (scan.z - height_at), kept, ignored, guess.near & ~ignored)
    information, moment, kept_number, edge, agreeing = scan.sums(*columns)
    height = guess.height + ratio(moment, information)
    # The paper ignores the points below a wall's top: a scan of its lower part alone has nothing against the top.
    settled = prior.support >= (cfg.edges.min_settled if cfg.edges is not None else 0.0)
    lower_part = (guess.side > 0) & (height < prior.elevation) & settled
    # Points on the face of a wall speak for its top.
    votes = kept_number + edge
    cells = ScanOfCells(
        height=height,
        # Of cells with points; elsewhere it need but be finite.
        variance=(1.0 / information.clamp(min=1e-12)).clamp(min=cfg.scan_variance_floor),
        kept=kept_number,
        votes=votes,
        dissent=guess.number - votes,
        agreeing=chosen(lower_part, votes, agreeing),
    )
    return cells, ignored


def gather_scan(m: Measurement, cells: PointCells, grid: GridConfig, cfg: FusionConfig) -> Scan:
    """Find what the update needs of each point, and whether its ray passed over the cell's centre."""
    xy, z, used = m.points[..., :2], m.points[..., 2], cells.inside
    from_center = xy - (torch.floor(xy / grid.resolution) + 0.5) * grid.resolution
    sensors = m.origin.shape[1]
    ray = (xy.unflatten(1, (sensors, -1)) - m.origin[:, :, None, :2]).flatten(1, 2)
    return Scan(
        z=z,
        spread=m.variance + (cfg.relief * grid.resolution) ** 2,
        weight=torch.where(used, 1.0 / m.variance, 0.0),
        used=used,
        ray=list(ray.unbind(-1)),
        passed=passed_center(from_center, ray),
        cells=cells,
    )


def passed_center(from_center: Tensor, ray: Tensor) -> Tensor:
    """Tell which rays passed over the middle of the cell before they hit: within 45 degrees of straight behind it.

    A wall that the ray meets at an angle also has points farther along the ray; those passed the centre by.
    """
    along = (from_center * ray).sum(-1)
    across = from_center[..., 0] * ray[..., 1] - from_center[..., 1] * ray[..., 0]
    return along > across.abs()


def gather_prior(state: MapState) -> Prior:
    """Flatten what the update reads of the map."""
    return Prior(
        elevation=state.elevation.flatten(1),
        variance=state.variance.flatten(1),
        known=state.validity.flatten(1),
        support=state.support.flatten(1),
        challenger=state.challenger.detach().flatten(1),
        challenger_support=state.challenger_support.flatten(1),
    )


def gate_variance(variance: Tensor, cfg: FusionConfig) -> Tensor:
    """Return the variance [m^2] that an elevation of this variance widens its gate by."""
    return variance.clamp(max=cfg.max_gate_std**2).detach()


def agrees(scan: Scan, height: Tensor, variance: Tensor, cfg: FusionConfig) -> Tensor:
    """Tell which points lie within the gate: |z - h| <= gate * sqrt(sigma_h^2 + sigma_p^2), a Mahalanobis distance."""
    return scan.used & ((scan.z - height).square() <= cfg.gate**2 * (scan.spread + variance))


def on_side(scan: Scan, guess: Tensor, gate: Tensor, side: Tensor, cfg: FusionConfig) -> tuple[Tensor, Tensor]:
    """Return the points kept and, in cells with a step, the points ignored as being of its other side."""
    residual = side * (scan.z - guess)
    margin = cfg.edges.margin if cfg.edges is not None else 0.0
    ignored = scan.used & (residual < -margin * scan.spread.sqrt())
    kept, ignored = realize_all(agrees(scan, guess, gate, cfg) & ~ignored, ignored)
    return kept, ignored


class ScanOfCells(NamedTuple):
    """What the scan says of each cell; heights in [m], the others count points."""

    height: Float[Tensor, "B C"]
    variance: Float[Tensor, "B C"]
    kept: Float[Tensor, "B C"]  # make up the height
    votes: Float[Tensor, "B C"]  # speak for the height
    dissent: Float[Tensor, "B C"]  # speak against it
    agreeing: Float[Tensor, "B C"]  # speak for the cell's elevation


def merge(
    state: MapState, prior: Prior, scan: ScanOfCells, challenge: Challenge, grid: GridConfig, cfg: FusionConfig
) -> tuple[MapState, Tensor]:
    """Take the scan's heights into the cells, or count them as votes against. Returns also where they were taken."""
    hit, innovation = scan.kept > 0, scan.height - prior.elevation
    limit = gate_variance(prior.variance, cfg) + scan.variance + (cfg.relief * grid.resolution) ** 2
    agree = realize(prior.known & hit & (innovation.square() <= cfg.gate**2 * limit))
    votes = chosen(agree, scan.votes - scan.dissent, scan.agreeing - scan.votes)
    support = prior.support + votes
    found = hit & ~agree & (~prior.known | (support < 0) | challenge.won)
    found, taken = realize_all(found, agree | found)

    information = ratio(as_factor(agree), prior.variance) + 1.0 / scan.variance
    fused = prior.elevation + masked(innovation / (information * scan.variance), taken)
    # Limited before it is multiplied, too: an infinite one would make NaN of cells without points.
    outvoted = prior.variance + min(cfg.outlier_variance, cfg.max_variance) * scan.kept
    posterior = chosen(taken, (1.0 / information).clamp(max=cfg.max_variance), outvoted.clamp(max=cfg.max_variance))
    fresh = chosen(prior.known & ~challenge.won, -support, scan.votes - scan.dissent)
    support = chosen(hit, chosen(found, fresh, support).clamp(0, cfg.max_support), prior.support)

    def store(cells: Tensor) -> Tensor:
        return cells.view(state.elevation.shape)

    hit_now = store(taken)
    elevation, variance, support, challenger, challenger_support, validity, time = realize_all(
        store(fused),
        chosen(state.validity | hit_now, store(posterior), BLANK["variance"]),
        store(support),
        store(challenge.height),
        store(zeroed(challenge.support, found)),
        state.validity | hit_now,
        torch.where(hit_now, 0.0, state.time),  # not multiplied: it may be infinite
    )
    stored = state._replace(
        elevation=elevation,
        variance=variance,
        support=support,
        challenger=challenger,
        challenger_support=challenger_support,
        validity=validity,
        time=time,
    )
    return stored, taken
