"""The cost of crossing a cell: by traversability and class of known ground, by the upper bound of unknown ground."""

from __future__ import annotations

import functools
import math
from dataclasses import dataclass, field, fields
from typing import TYPE_CHECKING, NamedTuple

import torch
from torch import Tensor

from torchelev.elevation_map import ElevationMap
from torchelev.errors import require, require_positive
from torchelev.inputs.checks import FLOATS, check_tensor, given_or_default
from torchelev.layers import Layer
from torchelev.ops.windows import padded, window_maximum
from torchelev.planning.class_costs import Costs, parse_costs, rate_classes
from torchelev.planning.limits import find_exceeded
from torchelev.planning.standing import mark_standing_cells
from torchelev.planning.terrain.ceilings import too_low
from torchelev.planning.terrain.inclination import compute_inclination
from torchelev.state import MapState

if TYPE_CHECKING:
    from jaxtyping import Bool, Float, Int


@dataclass(frozen=True, kw_only=True)
class TraversalCostConfig:
    """Thresholds that make ground impassable, and weights of passable ground. A metre of good known ground costs 1.

    Raises:
        ValueError: for a setting out of range.
    """

    min_traversability: float = 0.3  #: known ground rated below it is impassable; raise it for a more cautious robot
    weight_traversability: float = 4.0  #: cost added to a metre of ground rated 0; raise it for longer, safer paths
    weight_confidence: float = 1.0  #: cost added to a metre of unknown ground, or ground rated with confidence 0
    cross_unknown: bool = True  #: False makes all unknown ground impassable
    max_inclination: float = 0.5  #: [rad] unknown ground whose upper bound is steeper counts as a drop: impassable
    inclination_distance: float = 0.3  #: [m] over which the inclination is computed: half the span of the feet
    weight_inclination: float = 1.0  #: cost added to a metre of unknown ground inclined by max_inclination
    #: [m] by which impassable ground grows: half the robot's width, or 0 if the ratings include the robot's size
    inflation_radius: float = 0.0
    stand_radius: float = 0.4  #: [m] around the start, unknown ground is passable unless `standing` is given
    #: factors on the cost of a metre by channel and class, such as {"terrain": {"mud": 3.0, "water": math.inf}}; inf
    #: forbids a class, and a class without a factor counts 1
    class_costs: Costs = field(default_factory=dict, hash=False)
    max_forbidden: float = 0.3  #: probability of forbidden classes, together, above which ground is impassable
    unknown_class_cost: float = 1.0  #: factor on the cost of ground whose class is unknown
    #: [m] of the robot: ground below a lower ceiling is impassable, on maps with levels; at least their `min_gap`
    height: float | None = None

    def __post_init__(self) -> None:
        is_bool = isinstance(self.cross_unknown, bool)
        require(is_bool, "cost.cross_unknown", "must be a bool", repr(self.cross_unknown), "give True or False")
        object.__setattr__(self, "class_costs", parse_costs(self.class_costs))
        for name in (each.name for each in fields(self) if each.name != "class_costs"):
            value = getattr(self, name)
            if name == "height":
                self._require_height(value)
                continue
            in_range = isinstance(value, int | float) and 0 <= value < math.inf
            require(in_range, f"cost.{name}", "must be at least 0", repr(value), "leave it out for its default")
        in_range = self.min_traversability <= 1
        require(in_range, "cost.min_traversability", "must lie in [0, 1]", self.min_traversability, "give 0.3")
        in_range = 0 < self.max_inclination < math.pi / 2
        require(in_range, "cost.max_inclination", "must lie between 0 and pi / 2", self.max_inclination, "give radians")
        require(self.max_forbidden < 1, "cost.max_forbidden", "must lie in [0, 1)", self.max_forbidden, "give 0.3")
        for name in ("inclination_distance", "unknown_class_cost"):
            require_positive(**{f"cost.{name}": getattr(self, name)})

    def _require_height(self, value: object) -> None:
        is_height = value is None or (isinstance(value, int | float) and not isinstance(value, bool))
        require(is_height, "cost.height", "must be a number or None", repr(value), "give metres")
        if value is not None:
            require_positive(**{"cost.height": value})


def traversal_cost(
    emap: ElevationMap,
    cfg: TraversalCostConfig | None = None,
    *,
    confidence: Float[Tensor, "B H W"] | None = None,
    start: Int[Tensor, "B 2"] | None = None,
    standing: Float[Tensor, "B V 2"] | None = None,
    state: MapState | None = None,
) -> Float[Tensor, "B H W"]:
    """Compute the cost of each metre of a path through each cell.

    With the traversability t, its confidence q, and the inclination a of the upper bound (`compute_inclination`):

        t known:                     1 + w_t (1 - t) + w_c (1 - q)   impassable where t < min_traversability
        only elevation or its bound: 1 + w_a a / max_a + w_c         impassable where a > max_inclination or unknown
        nothing known:               impassable
        beyond the robot's limits:   impassable, whatever the rating (`planning.limits`)
        of a class with a cost:      times the factor, or impassable if forbidden (`class_costs.rate_classes`)
        under a low ceiling:         impassable, on maps with levels, where the clearance is less than `height`

    Behind an edge, rays that passed over it bound the unseen ground from above. The nearer the robot is, the steeper it
    looks down, and ground that its rays still miss falls away more steeply than they do. So a steep bound indicates a
    drop, and a gentle one ground that may continue (paper, Sec. II-H). From afar a drop looks gentle too: plan again
    on the way.

    Args:
        emap: the maps.
        cfg: thresholds and weights.
        confidence: confidence of the traversability, 0 to 1; None: that of the learned head, else 1.
        start: cell (i, j) on which each robot stands. It is passable, even if it is rated impassable.
        standing: footprints on which the robots stand now [m], map frame (`standing.place_footprint`): cells of unknown
            traversability below them are passable. None: those within `stand_radius` of `start`.
        state: the state to read; None: that of the maps.

    Returns:
        The costs: at least 1 without `class_costs`, else positive; inf where impassable.

    Raises:
        ValueError, TypeError: for a wrong shape, dtype or device, a map without traversability, or a channel of
            `class_costs` that is not one of classes.
        KeyError: for a channel or class of `class_costs` that the map lacks.
    """
    cfg = given_or_default(TraversalCostConfig, cfg)
    found = find_obstruction(emap, cfg, state)
    return cost_within(found, emap, cfg, confidence=confidence, start=start, standing=standing, state=state)


class Obstruction(NamedTuple):
    """What makes cells impassable or changes their cost, whatever their rating."""

    exceeded: list[Bool[Tensor, "B H W"]]  #: the cells beyond each `Limit`, in their order
    factor: Float[Tensor, "B H W"] | None  #: on the cost of each cell; None: 1


def find_obstruction(emap: ElevationMap, cfg: TraversalCostConfig, state: MapState | None = None) -> Obstruction:
    """Find the cells beyond the robot's limits and those of forbidden classes, and the factors of the others."""
    exceeded = find_exceeded(emap.state if state is None else state, emap.cfg)
    low, factor = too_low(emap, cfg.height, state), None
    forbidden = torch.zeros_like(exceeded[0])
    if cfg.class_costs:
        rating = rate_classes(emap, cfg.class_costs, cfg.max_forbidden, cfg.unknown_class_cost, state)
        forbidden, factor = rating.is_forbidden, rating.factor
    if cfg.class_costs or low is not None:
        exceeded.append(forbidden)
    return Obstruction(exceeded if low is None else [*exceeded, low], factor)


def cost_within(
    found: Obstruction,
    emap: ElevationMap,
    cfg: TraversalCostConfig,
    *,
    confidence: Float[Tensor, "B H W"] | None = None,
    start: Int[Tensor, "B 2"] | None = None,
    standing: Float[Tensor, "B V 2"] | None = None,
    state: MapState | None = None,
) -> Float[Tensor, "B H W"]:
    """Compute `traversal_cost`, given what `find_obstruction` returned."""
    hint = "give ElevationMapConfig a TraversabilityConfig"
    require(emap.cfg.traversability is not None, "traversability", "must not be switched off", "None", hint)
    given, state = state, emap.state if state is None else state
    if confidence is None and emap.head is not None:
        confidence = emap.rate(state=state).confidence
    if confidence is not None:
        confidence = check_tensor("confidence", confidence, emap.device, FLOATS)
        shape = tuple(state.elevation.shape)
        fits = tuple(confidence.shape) == shape
        require(fits, "confidence", f"expected {shape}", tuple(confidence.shape), "give one for each cell")
    rated, bound = (emap.read_layer(name, given) for name in ("traversability", "upper_bound"))
    below = None if standing is None else mark_standing_cells(emap, standing, state)
    beyond = functools.reduce(torch.logical_or, found.exceeded)
    resolution = emap.cfg.grid.resolution
    return cost_of_layers(rated, bound, resolution, cfg, confidence, start, below, beyond, found.factor)


def cost_of_layers(
    rated: Layer,
    bound: Layer,
    resolution: float,
    cfg: TraversalCostConfig,
    confidence: Tensor | None = None,
    start: Int[Tensor, "B 2"] | None = None,
    standing: Bool[Tensor, "B H W"] | None = None,
    exceeded: Bool[Tensor, "B H W"] | None = None,
    factor: Float[Tensor, "B H W"] | None = None,
) -> Float[Tensor, "B H W"]:
    """Compute `traversal_cost` from layers. Values of cells that are not known are ignored.

    Args:
        rated: the traversability, and where it is known.
        bound: the elevation where it is known, else its upper bound, and where either is known.
        resolution: side of a cell [m].
        cfg: thresholds and weights.
        confidence: confidence of the traversability, 0 to 1; None: 1.
        start: cell (i, j) on which each robot stands.
        standing: the cells on which the robots stand now.
        exceeded: the cells beyond a limit of the robots, or of a forbidden class.
        factor: on the cost of each cell, positive; None: 1.
    """
    t, is_rated = rated
    doubt = torch.zeros_like(t) if confidence is None else 1 - confidence.to(t.dtype).nan_to_num(0.0).clamp(0, 1)
    cost = 1 + cfg.weight_traversability * (1 - t.clamp(0, 1)) + cfg.weight_confidence * doubt
    cost = torch.where(is_rated & (t >= cfg.min_traversability), cost, torch.inf)
    if cfg.cross_unknown:
        angle, is_inclined = compute_inclination(bound, resolution, cfg.inclination_distance)
        unknown_cost = 1 + cfg.weight_confidence + cfg.weight_inclination / cfg.max_inclination * angle
        is_gentle = is_inclined & ~is_rated & (angle <= cfg.max_inclination)
        cost = torch.where(is_gentle, unknown_cost, cost)
    if factor is not None:
        cost = cost * factor.to(cost.dtype)
    if standing is None and start is not None:
        standing = mark_disc(start, cost, cfg.stand_radius / resolution)
    if standing is not None:
        # Before inflation, or unknown ground below the robot would enclose it.
        cost = _open(cost, ~is_rated & standing, cfg)
    if exceeded is not None:
        cost = torch.where(exceeded, torch.inf, cost)
    cost = _inflate(cost, round(cfg.inflation_radius / resolution))
    return cost if start is None else _open(cost, mark_disc(start, cost, 0.0), cfg)


def _inflate(cost: Tensor, radius: int) -> Float[Tensor, "B H W"]:
    """Make all cells within a square of `radius` cells around impassable ground impassable."""
    return cost if radius == 0 else torch.where(widen(torch.isinf(cost), radius), torch.inf, cost)


def widen(cells: Bool[Tensor, "B H W"], radius: int) -> Bool[Tensor, "B H W"]:
    """Mark all cells within a square of `radius` cells around marked ones."""
    if radius == 0:
        return cells
    (is_near,) = window_maximum([padded(cells.to(torch.float32), radius, 0.0)], radius, radius)
    return is_near > 0


def _open(cost: Tensor, cells: Bool[Tensor, "B H W"], cfg: TraversalCostConfig) -> Float[Tensor, "B H W"]:
    """Make impassable ones of these cells passable, at the highest cost of known ground."""
    highest = 1 + cfg.weight_traversability + cfg.weight_confidence
    return torch.where(cells & torch.isinf(cost), highest, cost)


def mark_disc(center: Int[Tensor, "B 2"], like: Tensor, radius: float) -> Bool[Tensor, "B H W"]:
    """Mark the cells within `radius` [cells] of the cell `center` (i, j) of each map, in the shape of `like`."""
    i = torch.arange(like.shape[1], device=like.device)[None, :, None] - center[:, 0, None, None]
    j = torch.arange(like.shape[2], device=like.device)[None, None, :] - center[:, 1, None, None]
    return i.square() + j.square() <= radius**2
