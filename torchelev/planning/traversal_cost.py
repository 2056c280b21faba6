"""What a metre of way costs a robot: from the rating of known ground, and the upper bound where nothing is known."""

from __future__ import annotations

import math
from dataclasses import dataclass, fields
from typing import TYPE_CHECKING

import torch
from torch import Tensor

from torchelev.checks import FLOATS, check_tensor, given_or_default
from torchelev.elevation_map import ElevationMap
from torchelev.errors import require, require_positive
from torchelev.layers import Layer
from torchelev.ops.operators import padded
from torchelev.ops.windows import AROUND, shifted, window_maximum
from torchelev.planning.standing import standing_cells
from torchelev.state import MapState

if TYPE_CHECKING:
    from jaxtyping import Bool, Float, Int


@dataclass(frozen=True, kw_only=True)
class TraversalCostConfig:
    """What makes ground impassable, and what the rest costs. The weights are added to 1 for each metre."""

    min_traversability: float = 0.3  #: known ground rated below it is impassable
    weight_traversability: float = 4.0  #: of ground rated 0
    weight_confidence: float = 1.0  #: of ground whose rating is worth nothing, or that is not known
    cross_unknown: bool = True  #: False: whatever is not known is impassable
    max_inclination: float = 0.5  #: [rad] of the upper bound; steeper, what is not known is taken for a drop
    inclination_distance: float = 0.3  #: [m] over which the inclination is taken: half of what the feet span
    weight_inclination: float = 1.0  #: of unknown ground at max_inclination
    inflation_radius: float = 0.0  #: [m] by which what is impassable grows; 0 for ratings that count the robot's size
    stand_radius: float = 0.4  #: [m] around a path's start the robot stands, if no `standing` footprint is given

    def __post_init__(self) -> None:
        whole = isinstance(self.cross_unknown, bool)
        require(whole, "cost.cross_unknown", "must be a bool", repr(self.cross_unknown), "give True or False")
        for field in fields(self):
            value = getattr(self, field.name)
            good = isinstance(value, int | float) and 0 <= value < math.inf
            require(good, f"cost.{field.name}", "must be at least 0", repr(value), "leave it out for its default")
        rated = self.min_traversability <= 1
        require(rated, "cost.min_traversability", "must lie in [0, 1]", self.min_traversability, "give 0.3")
        flat = 0 < self.max_inclination < math.pi / 2
        require(flat, "cost.max_inclination", "must lie between 0 and pi / 2", self.max_inclination, "give radians")
        require_positive(**{"cost.inclination_distance": self.inclination_distance})


def traversal_cost(
    emap: ElevationMap,
    cfg: TraversalCostConfig | None = None,
    *,
    confidence: Float[Tensor, "B H W"] | None = None,
    start: Int[Tensor, "B 2"] | None = None,
    standing: Float[Tensor, "B V 2"] | None = None,
    state: MapState | None = None,
) -> Float[Tensor, "B H W"]:
    """Return what each cell costs for each metre of way: at least 1, inf where it is impassable.

    With traversability t, its confidence q and the inclination a of the upper bound (`inclination`), of ground that is

        rated:             1 + w_t (1 - t)      + w_c (1 - q)   impassable where t < min_traversability
        known or bounded:  1 + w_a a / max_a    + w_c           impassable where a > max_inclination, or is unknown
        neither:           impassable

    Ground of known elevation but unknown traversability is not rated: its elevation is its upper bound.

    Behind an edge, rays that passed over it bound the unseen ground. The nearer the robot, the steeper they look down,
    and ground that they still do not meet falls more steeply than they: a steep bound means a drop, a gentle one
    ground that may go on (paper, Sec. II-H). From afar a drop looks gentle too, so plan again on the way.

    Args:
        emap: the maps.
        cfg: thresholds and weights.
        confidence: of the traversability, 0 to 1; None: the learned head's own, else 1.
        start: cell (i, j) on which each robot stands: it is passable, even if it is rated impassable.
        standing: footprints on which the robots stand now [m], map frame (`standing.place_footprint`): unrated ground
            under them is passable. None: within `stand_radius` of `start`.
        state: of the maps; None: their own.

    Raises ValueError or TypeError for a confidence that does not fit, and a map whose traversability is switched off.
    """
    cfg = given_or_default(TraversalCostConfig, cfg)
    hint = "give ElevationMapConfig a TraversabilityConfig"
    require(emap.cfg.traversability is not None, "traversability", "must not be switched off", "None", hint)
    state = emap.state if state is None else state
    if confidence is None and emap.head is not None:
        confidence = emap.rate(state=state).confidence
    if confidence is not None:
        confidence = check_tensor("confidence", confidence, emap.device, FLOATS)
        shape = tuple(state.elevation.shape)
        fits = tuple(confidence.shape) == shape
        require(fits, "confidence", f"expected {shape}", tuple(confidence.shape), "give one for each cell")
    rated, bound = emap.read_layer("traversability", state), emap.read_layer("upper_bound", state)
    ground = None if standing is None else standing_cells(emap, standing, state)
    return cost_of_layers(rated, bound, emap.cfg.grid.resolution, cfg, confidence, start, ground)


def cost_of_layers(
    rated: Layer,
    bound: Layer,
    resolution: float,
    cfg: TraversalCostConfig,
    confidence: Tensor | None = None,
    start: Int[Tensor, "B 2"] | None = None,
    standing: Bool[Tensor, "B H W"] | None = None,
) -> Float[Tensor, "B H W"]:
    """Return `traversal_cost` of layers: the traversability, and the upper bound, which is the elevation where known.

    `standing` marks the cells on which the robots stand now. Each layer is values and where they are known, (B, H, W)
    both. What a layer holds where it is not known does not count.
    """
    t, known = rated
    doubt = torch.zeros_like(t) if confidence is None else 1 - confidence.to(t.dtype).nan_to_num(0.0).clamp(0, 1)
    cost = 1 + cfg.weight_traversability * (1 - t.clamp(0, 1)) + cfg.weight_confidence * doubt
    cost = torch.where(known & (t >= cfg.min_traversability), cost, torch.inf)
    if cfg.cross_unknown:
        angle, tells = inclination(bound, resolution, cfg.inclination_distance)
        guess = 1 + cfg.weight_confidence + cfg.weight_inclination / cfg.max_inclination * angle
        gentle = tells & ~known & (angle <= cfg.max_inclination)
        cost = torch.where(gentle, guess, cost)
    cells = round(cfg.inflation_radius / resolution)
    if standing is None and start is not None:
        standing = disc(start, cost, cfg.stand_radius / resolution)
    if standing is not None:
        # Before what is impassable grows: unknown ground below the robot must not cage it.
        cost = _opened(cost, ~known & standing, cfg)
    cost = _inflated(cost, cells)
    return cost if start is None else _opened(cost, disc(start, cost, 0.0), cfg)


def inclination(bound: Layer, resolution: float, distance: float) -> Layer:
    """Return how steeply a surface rises or falls around each cell [rad], and where it is known.

    atan max_k |u_k - u| / d_k over eight places, `distance` [m] away along x, y and the diagonals to the nearest cell,
    as far as they are known. Known where the cell is, and those along two perpendicular directions: one direction says
    nothing of the slope across it. Over the span of its feet a robot crosses a step of some height as it does a slope;
    a steeper place in between does not count.
    """
    known = bound[1]
    values = torch.where(known, bound[0], 0.0)
    reach = max(1, round(distance / resolution))
    aslant = max(1, round(reach / math.sqrt(2)))
    offsets = [(i * n, j * n) for i, j in AROUND for n in [aslant if i and j else reach]]
    height, there = (padded(layer, reach, 0.0) for layer in (values, known.to(values.dtype)))
    steepest = torch.zeros_like(values)
    axes = {axis: torch.zeros_like(known) for axis in ((1, 0), (0, 1), (1, 1), (1, -1))}
    for (i, j), axis in zip(offsets, map(_axis, AROUND), strict=True):
        step = shifted(height, reach, i, j) - values
        other = shifted(there, reach, i, j)
        steepest = torch.maximum(steepest, step.abs() * other / (math.hypot(i, j) * resolution))
        axes[axis] = axes[axis] | (other > 0)
    found = known & ((axes[1, 0] & axes[0, 1]) | (axes[1, 1] & axes[1, -1]))
    return torch.where(found, torch.atan(steepest), 0.0), found


def _axis(step: tuple[int, int]) -> tuple[int, int]:
    """Return the direction of a step, without its sign."""
    i, j = step
    return (i, j) if (i, j) > (0, 0) else (-i, -j)


def _inflated(cost: Tensor, radius: int) -> Float[Tensor, "B H W"]:
    """Make impassable what lies within a square of so many cells around impassable ground."""
    if radius == 0:
        return cost
    blocked = torch.isinf(cost).to(cost.dtype)
    (near,) = window_maximum([padded(blocked, radius, 0.0)], radius, radius)
    return torch.where(near > 0, torch.inf, cost)


def disc(center: Int[Tensor, "B 2"], like: Tensor, radius: float) -> Bool[Tensor, "B H W"]:
    """Mark the cells (i, j) within `radius` [cells] of each map's `center`."""
    i = torch.arange(like.shape[1], device=like.device)[None, :, None] - center[:, 0, None, None]
    j = torch.arange(like.shape[2], device=like.device)[None, None, :] - center[:, 1, None, None]
    return i.square() + j.square() <= radius**2


def _opened(cost: Tensor, cells: Bool[Tensor, "B H W"], cfg: TraversalCostConfig) -> Float[Tensor, "B H W"]:
    """Make impassable cells passable, at the cost of ground rated 0 in doubt."""
    worst = 1 + cfg.weight_traversability + cfg.weight_confidence
    return torch.where(cells & torch.isinf(cost), worst, cost)
