"""The height update: one scan's points of a cell become one estimate, which the cell takes or rejects."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, NamedTuple

import torch
from torch import Tensor

from torchelev.disputed import NO_HEIGHT, Disputed, Shown, ratio, settle
from torchelev.edges import EdgeConfig
from torchelev.errors import require
from torchelev.grid import GridConfig, PointCells
from torchelev.masks import as_factor, chosen, masked
from torchelev.operators import padded
from torchelev.state import BLANK, MapState, Measurement, count, tally
from torchelev.storage import as_bytes, realize, realize_all
from torchelev.windows import window_maximum, window_moments

if TYPE_CHECKING:
    from jaxtyping import Bool, Float, Int

MIN_CHALLENGERS = 4  # in the 3 x 3 window: so many stand on one obstacle, whose face shows at all heights


@dataclass(frozen=True, kw_only=True)
class FusionConfig:
    """Kalman update and outlier gate."""

    gate: float = 3.0  # Mahalanobis distance beyond which a point is an outlier
    max_gate_std: float = 0.05  # [m] an uncertain cell's gate grows no wider, or an outlier would slip in
    relief: float = 0.25  # [cells] standard deviation of height within a cell of rough or sloped ground
    scan_variance_floor: float = 1e-6  # [m^2] points of one scan share the error of its pose
    outlier_variance: float = 1e-4  # [m^2] added by a scan that mostly disagrees
    max_support: float = 60.0  # points; how many must disagree until a settled cell is founded anew
    min_above: float = 5.0  # points of one height above a cell that found it anew, however settled it is
    max_above_per_scan: float = 2.0  # of those points, how many one scan adds: a single bad scan is no obstacle
    max_variance: float = 1.0  # [m^2]
    edges: EdgeConfig | None = EdgeConfig()

    def __post_init__(self) -> None:
        fits, mend = self.edges is None or isinstance(self.edges, EdgeConfig), "None keeps no edges sharp"
        require(fits, "fusion.edges", "must be an EdgeConfig or None", repr(self.edges), mend, TypeError)
        for name in ("gate", "max_gate_std", "scan_variance_floor", "min_above", "max_above_per_scan", "max_variance"):
            require(
                getattr(self, name) > 0, f"fusion.{name}", "must be positive", getattr(self, name), "see its default"
            )
        for name in ("scan_variance_floor", "max_variance"):
            finite, mend = math.isfinite(getattr(self, name)), "give a large number such as 1e6"
            require(finite, f"fusion.{name}", "must be finite", getattr(self, name), mend)


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
    challenger_support: Float[Tensor, "B C"]


def fuse(
    state: MapState, m: Measurement, cells: PointCells, grid: GridConfig, cfg: FusionConfig, has_rays: bool = True
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
    scanned, ignored = scan_of_cells(scan, prior, guess, cfg)
    state, taken = merge(state, prior, scanned, grid, cfg, has_rays)
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
    near: Bool[Tensor, "B M"]  # points that agree with the cell's elevation
    gate_at: Float[Tensor, "B M"]  # [m^2] of the elevation of each point's cell


def guess_heights(scan: Scan, prior: Prior, grid: GridConfig, cfg: FusionConfig) -> Guess:
    """Trust a cell's elevation where most points agree with it, else the robust mean, and at a step one of its ends."""
    elevation_at, variance_at = scan.cells.take(prior.elevation, prior.variance)
    gate_at = gate_variance(variance_at, cfg)
    near, gate_at = realize_all(agrees(scan, elevation_at, gate_at, cfg), gate_at)
    number, agreeing, weight, moment = scan.sums(scan.used, near, scan.weight, scan.weight * scan.z)
    number = realize(number.clamp(min=0))  # a copy of its own, or all four sums would be held as long as this one
    mean = ratio(moment, weight).detach()
    trusted = prior.known & (2 * agreeing >= number)
    # A single point is its cell's robust mean, and most cells of a sparse scan have one.
    step, untrusted = torch.zeros_like(trusted), ~trusted & (number > 1)
    if (edges := cfg.edges) is not None:
        step = trusted & edges.holds_step(number, number - agreeing)
    height = chosen(trusted, prior.elevation, mean).detach()
    shown = Shown(chosen(number > 0, mean, NO_HEIGHT), chosen(prior.known, prior.elevation.detach(), NO_HEIGHT))
    cells = as_bytes(untrusted) + 2 * as_bytes(step)
    points = Disputed(cells, scan.cells.slot, scan.columns(), shown.scan)
    height, side = settle(points, height, shown, grid.width, cfg.gate, cfg.relief * grid.resolution, edges)
    return Guess(height, side, trusted, number, near, gate_at)


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
    above = prior.known & ~guess.trusted & (guess.height > prior.elevation)
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
        guess=guess.height,
        rise=guess.number * (2.0 * as_factor(above) - 1.0),
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
        challenger=state.challenger.flatten(1),
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
    guess: Float[Tensor, "B C"]  # [m] what its points are about, without a gradient
    rise: Float[Tensor, "B C"]  # all points; negative unless most contradict the cell's elevation from above


def merge(
    state: MapState, prior: Prior, scan: ScanOfCells, grid: GridConfig, cfg: FusionConfig, has_rays: bool
) -> tuple[MapState, Tensor]:
    """Take the scan's heights into the cells, or count them as votes against. Returns also where they were taken."""
    hit, innovation = scan.kept > 0, scan.height - prior.elevation
    limit = gate_variance(prior.variance, cfg) + scan.variance + (cfg.relief * grid.resolution) ** 2
    agree = realize(prior.known & hit & (innovation.square() <= cfg.gate**2 * limit))
    votes = chosen(agree, scan.votes - scan.dissent, scan.agreeing - scan.votes)
    support = prior.support + votes
    around = shown_around(state, prior, cfg)
    scan = scan._replace(rise=chosen(at_known_step(scan, around, limit, cfg), -scan.rise.abs(), scan.rise))
    challenger, challenger_support = challenge(prior, scan, around.challengers, limit, cfg)
    # Without rays nothing tells outliers in a blind spot from an obstacle.
    risen = (scan.rise > 0) & (challenger_support >= cfg.min_above) if has_rays else torch.zeros_like(hit)
    found = hit & ~agree & (~prior.known | (support < 0) | risen)
    taken = realize(agree | found)

    information = ratio(as_factor(agree), prior.variance) + 1.0 / scan.variance
    fused = prior.elevation + masked(innovation / (information * scan.variance), taken)
    # Limited before it is multiplied, too: an infinite one would make NaN of cells without points.
    outvoted = prior.variance + min(cfg.outlier_variance, cfg.max_variance) * scan.kept
    posterior = chosen(taken, (1.0 / information).clamp(max=cfg.max_variance), outvoted.clamp(max=cfg.max_variance))
    fresh = chosen(prior.known & ~risen, -support, scan.votes - scan.dissent)
    support = chosen(hit, chosen(found, fresh, support).clamp(0, cfg.max_support), prior.support)

    def store(cells: Tensor) -> Tensor:
        return cells.view(state.elevation.shape)

    hit_now = store(taken)
    elevation, variance, support, challenger, challenger_support, validity, time = realize_all(
        store(fused),
        chosen(state.validity | hit_now, store(posterior), BLANK["variance"]),
        store(support),
        store(challenger),
        store(masked(challenger_support.clamp(0, cfg.min_above), ~found)),
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


class Around(NamedTuple):
    """What the map shows in the 3 x 3 window around each cell."""

    challengers: Float[Tensor, "B C"]  # how many
    settled: Float[Tensor, "B C"]  # [m] highest of the settled elevations, NO_HEIGHT without


def shown_around(state: MapState, prior: Prior, cfg: FusionConfig) -> Around:
    """Look at the cells around each cell, and at itself: before the scan, so that its own outliers vouch for none."""

    def rimmed(cells: Tensor, fill: float) -> Tensor:
        return padded(cells.view(state.elevation.shape), 1, fill)

    exists = (prior.challenger_support > 0).to(prior.elevation.dtype)
    settled = prior.known & (prior.support >= 0.5 * cfg.max_support)
    (number,) = window_moments([(rimmed(exists, 0.0), 0)], 1, 1)
    (top,) = window_maximum([rimmed(chosen(settled, prior.elevation.detach(), NO_HEIGHT), NO_HEIGHT)], 1, 1)
    return Around(number.flatten(1), top.flatten(1))


def at_known_step(scan: ScanOfCells, around: Around, limit: Tensor, cfg: FusionConfig) -> Bool[Tensor, "B C"]:
    """Tell where a settled cell beside it stands as high as the points: another view of a step, which is not new.

    There the majority vote decides alone. The cells of a new obstacle are not settled until most of them show.
    """
    return around.settled >= scan.guess - cfg.gate * limit.detach().sqrt()


def challenge(
    prior: Prior, scan: ScanOfCells, challengers: Tensor, limit: Tensor, cfg: FusionConfig
) -> tuple[Tensor, Tensor]:
    """Let points above the elevation agree with each other: return the challenger's height [m] and its support.

    The challenger is the lowest height that contradicted the elevation from above, and what lies within the gate of it
    supports it, or all that lies above where `MIN_CHALLENGERS` challengers stand together. Other higher points count
    neither way; a lower one replaces it. A scan that does not contradict the elevation takes its points off. With 6 %
    of the points above the ground, at 0.5 to 10 points a cell, chance gives a cell three scans in a row, and three
    challengers beside it, in fewer than one scan of 10^7. A blind spot, which only outliers hit, is settled by
    `clear_seen_through`: rays that pass below the challenger refute it.
    """
    votes = scan.rise.clamp(-cfg.max_above_per_scan, cfg.max_above_per_scan)
    above, exists = scan.rise > 0, prior.challenger_support > 0
    backed = above & (challengers >= MIN_CHALLENGERS)
    difference = scan.guess - prior.challenger
    near = difference.square() <= cfg.gate**2 * limit.detach()
    replaced = above & ~(exists & (near | (difference > 0)))
    challenger = chosen(replaced, scan.guess, prior.challenger)
    kept = masked(prior.challenger_support, ~replaced | backed)
    return challenger, (kept + masked(votes, near | ~above | replaced | backed)).clamp(min=0)
