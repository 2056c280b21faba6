"""Check where a robot may stand: footprints as polygons, rated by the traversability of the cells below them."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
import torch
from torch import Tensor

from torchelev.elevation_map import ElevationMap
from torchelev.errors import require, require_positive
from torchelev.inputs.checks import given_or_default
from torchelev.levels.config import is_too_low, needed_height
from torchelev.planning.limits import ROUNDING, Limit, first_limit, limits_of
from torchelev.planning.polygons import convex_hull
from torchelev.planning.terrain.ceilings import lowest_ceiling
from torchelev.planning.terrain.ground import fit_below, read_ground
from torchelev.state import MapState

if TYPE_CHECKING:
    from jaxtyping import Bool, Float, Int


@dataclass(frozen=True, kw_only=True)
class FootprintConfig:
    """Thresholds for the ground below a footprint. Fractions are of all cells of the polygon.

    The defaults suit the analytic head, which rates a slope of 20 degrees, a step of 10 cm or a roughness of 2.5 cm
    as 0.5, and 28 degrees, 14 cm or 3.5 cm as 0.3. The learned head rates whether the body can stand over a cell: with
    it, check the region in which the body's centre may lie, not the outline of the body.

    Raises:
        ValueError: for a setting out of range.
    """

    layer: str = "traversability"  #: layer that rates the ground from 0 (bad) to 1 (good)
    min_traversability: float = 0.5  #: lowest accepted mean over the known cells; raise it for a more cautious robot
    unsafe_traversability: float = 0.3  #: known cells rated below it count as unsafe
    max_unsafe: float = 0.05  #: largest accepted fraction of unsafe cells; 0 accepts no unsafe cell at all
    max_unknown: float = 0.2  #: largest accepted fraction of cells unknown or outside the window; raise for sparse maps
    max_extent: float = 1.5  #: [m] largest accepted polygon along x and y; the cost grows with its square
    #: [m] of the robot: a footprint below a lower ceiling is not safe, on maps with levels; at least their `min_gap`
    height: float | None = None

    def __post_init__(self) -> None:
        for name in ("min_traversability", "unsafe_traversability", "max_unsafe", "max_unknown"):
            value = getattr(self, name)
            is_number = isinstance(value, int | float) and not isinstance(value, bool)
            in_range = is_number and 0 <= value <= 1
            require(in_range, f"footprint.{name}", "must lie in [0, 1]", repr(value), "leave it out for its default")
        require_positive(**{"footprint.max_extent": self.max_extent})
        if self.height is not None:
            require_positive(**{"footprint.height": self.height})


class FootprintCheck(NamedTuple):
    """Ratings of P footprints on each of B maps. Means and fractions lie in [0, 1]."""

    #: mean traversability and fractions of unsafe and unknown cells meet the thresholds, and the ground the limits
    safe: Bool[Tensor, "B P"]
    traversability: Float[Tensor, "B P"]  #: mean over the known cells; 0 if none is known
    unknown: Float[Tensor, "B P"]  #: fraction of cells unknown or outside the window, except under the standing robot
    unsafe: Float[Tensor, "B P"]  #: fraction of cells known to be unsafe
    step: Float[Tensor, "B P"]  #: [m] the highest step of a cell, as of `limits.compute_steps`
    slope: Float[Tensor, "B P"]  #: [rad] inclination of the plane through the known cells
    clearance: Float[Tensor, "B P"]  #: [m] height of the highest known cell above the plane through the outer ones
    ceiling: Float[Tensor, "B P"]  #: [m] height of the lowest ceiling above the ground; infinite where none is known
    limit: Int[Tensor, "B P"]  #: the first `limits.Limit` of the robot that is exceeded; 0: none


def check_footprint(
    emap: ElevationMap,
    polygons: Float[Tensor, "B P V 2"],
    cfg: FootprintConfig | None = None,
    *,
    standing: Float[Tensor, "B V 2"] | None = None,
    state: MapState | None = None,
) -> FootprintCheck:
    """Check whether the robot can stand on the ground below footprints.

    A footprint is safe if the mean traversability of its known cells is high enough and its fractions of unsafe and
    unknown cells are low enough. A cell whose elevation is known but whose traversability is not counts as unknown. A
    footprint without any known cell is safe only where the robot stands now. The mean is differentiable in the state.

    Nor may the ground exceed the robot's limits, however well it is rated (`limits.limits_of`): no cell has a higher
    step, the plane through the known cells is not steeper, and no cell is higher above the outer ones than the belly.
    On maps with levels, the robot fits below the ceiling of every cell. `limit` names the first one that is exceeded.

    The paper's open code offers planners a similar check. It crops polygons at the window's border, ignores unknown
    cells and bounds the number of unsafe cells; here cells outside the window and unknown cells count as unknown, and
    fractions are bounded.

    Args:
        emap: the maps.
        polygons: vertices [m], map frame, convex or not, in either orientation. Pad polygons with fewer vertices by
            repeating the last one. `polygons.rasterize` says which cells belong to a polygon.
        cfg: the thresholds.
        standing: footprints on which the robots stand now [m], map frame (`standing.place_footprint`). Unknown cells
            below them are assumed to be passable: they count neither as unknown nor in the mean. Known cells count as
            elsewhere. None or NaN: nothing is assumed.
        state: the state to read; None: that of the maps.

    Raises:
        ValueError, TypeError: for a wrong shape, dtype or device, fewer than 3 vertices, or a map without
            traversability. On a CPU, or with the map's `check_values`, also for polygons with NaN or inf or larger than
            `max_extent`; elsewhere, where reading them would make the host wait, these are not safe and all unknown.
        KeyError: for an unknown layer.
    """
    cfg = given_or_default(FootprintConfig, cfg)
    ground = read_ground(emap, polygons, cfg.layer, cfg.max_extent, state, standing)
    values = ground.values
    is_unsafe = ground.known & (values < cfg.unsafe_traversability)
    ceiling = lowest_ceiling(emap, ground.cells, state)
    masks = (ground.cells.inside, ground.known, is_unsafe, ground.assumed)
    total, known, unsafe, assumed = (mask.flatten(-2).sum(-1, dtype=torch.int32) for mask in masks)
    mean = values.flatten(-2).sum(-1) / known.clamp(min=1).to(values.dtype)
    divisor = total.clamp(min=1).double()
    unknown_fraction = torch.where(total > 0, (total - known - assumed) / divisor, 1.0).to(values.dtype)
    unsafe_fraction = (unsafe / divisor).to(values.dtype)
    has_few_bad_cells = (unsafe_fraction <= cfg.max_unsafe) & (unknown_fraction <= cfg.max_unknown)
    has_good_mean = torch.where(known > 0, mean >= cfg.min_traversability, assumed > 0)
    ground_values = (ground.steps.flatten(-2).amax(-1), *fit_below(ground, emap.cfg.grid.resolution))
    beyond = (
        *limits_of(emap.cfg).exceeded(*ground_values),
        is_too_low(ceiling, needed_height(emap.cfg.levels, cfg.height)),
    )
    limit = first_limit(dict(zip((Limit.STEP, Limit.SLOPE, Limit.CLEARANCE, Limit.CEILING), beyond, strict=True)))
    safe = has_few_bad_cells & has_good_mean & (limit == Limit.NONE)
    step, slope, clearance, above = (value.to(mean.dtype) for value in (*ground_values, ceiling))
    return FootprintCheck(safe, mean, unknown_fraction, unsafe_fraction, step, slope, clearance, above, limit)


def unsafe_area(
    emap: ElevationMap,
    polygons: Float[Tensor, "B P V 2"],
    cfg: FootprintConfig | None = None,
    *,
    state: MapState | None = None,
) -> list[list[np.ndarray]]:
    """Return the convex hull of the unsafe cells below each footprint, and of those with too high a step.

    The host waits for the device, as the hulls differ in length. Arguments and errors are those of `check_footprint`.

    Returns:
        `[b][p]` -> (K, 2) float64 [m], map frame: the vertices around whole cells, counter-clockwise; (0, 2) where no
        cell is unsafe.
    """
    cfg = given_or_default(FootprintConfig, cfg)
    ground = read_ground(emap, polygons, cfg.layer, cfg.max_extent, state)
    corner = (emap.state if state is None else state).corner
    is_unsafe = ground.known & (ground.values < cfg.unsafe_traversability)
    bad = is_unsafe | (ground.steps > limits_of(emap.cfg).step + ROUNDING)
    unsafe, first = bad.cpu().numpy(), (ground.cells.first + corner[:, None]).cpu().numpy()
    return [
        [(convex_hull(cells) + offset) * emap.cfg.grid.resolution for cells, offset in zip(*both, strict=True)]
        for both in zip(unsafe, first, strict=True)
    ]
