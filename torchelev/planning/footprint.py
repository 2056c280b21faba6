"""Check where a robot may stand: footprints as polygons, rated by the traversability of the cells below them."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
import torch
from torch import Tensor

from torchelev.elevation_map import ElevationMap
from torchelev.errors import require, require_positive
from torchelev.grid import GridConfig
from torchelev.inputs.checks import FLOATS, check_tensor, given_or_default, readable
from torchelev.planning.polygons import PolygonCells, convex_hull, rasterize
from torchelev.planning.standing import MAX_CELL_OFFSET, mark_standing_cells
from torchelev.state import MapState

if TYPE_CHECKING:
    from jaxtyping import Bool, Float

ROUNDING = 1e-3  # [cells] tolerance on a polygon's extent


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

    def __post_init__(self) -> None:
        for name in ("min_traversability", "unsafe_traversability", "max_unsafe", "max_unknown"):
            value = getattr(self, name)
            is_number = isinstance(value, int | float) and not isinstance(value, bool)
            in_range = is_number and 0 <= value <= 1
            require(in_range, f"footprint.{name}", "must lie in [0, 1]", repr(value), "leave it out for its default")
        require_positive(**{"footprint.max_extent": self.max_extent})

    def max_cells(self, grid: GridConfig) -> int:
        """Return `max_extent` in cells, rounded up."""
        return math.ceil(self.max_extent / grid.resolution - 1e-6)


class FootprintCheck(NamedTuple):
    """Ratings of P footprints on each of B maps. Means and fractions lie in [0, 1]."""

    safe: Bool[Tensor, "B P"]  #: mean traversability and fractions of unsafe and unknown cells meet the thresholds
    traversability: Float[Tensor, "B P"]  #: mean over the known cells; 0 if none is known
    unknown: Float[Tensor, "B P"]  #: fraction of cells unknown or outside the window, except under the standing robot
    unsafe: Float[Tensor, "B P"]  #: fraction of cells known to be unsafe


class _Ground(NamedTuple):
    """The cells below footprints."""

    cells: PolygonCells
    values: Float[Tensor, "B P S S"]  # 0 where not known
    known: Bool[Tensor, "B P S S"]  # in the polygon and known
    unsafe: Bool[Tensor, "B P S S"]  # in the polygon and known to be unsafe
    assumed: Bool[Tensor, "B P S S"]  # in the polygon, unknown, and under the robot where it stands now


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
    ground = _read_ground(emap, polygons, cfg, state, standing)
    values = ground.values
    masks = (ground.cells.inside, ground.known, ground.unsafe, ground.assumed)
    total, known, unsafe, assumed = (mask.flatten(-2).sum(-1, dtype=torch.int32) for mask in masks)
    mean = values.flatten(-2).sum(-1) / known.clamp(min=1).to(values.dtype)
    divisor = total.clamp(min=1).double()
    unknown_fraction = torch.where(total > 0, (total - known - assumed) / divisor, 1.0).to(values.dtype)
    unsafe_fraction = (unsafe / divisor).to(values.dtype)
    has_few_bad_cells = (unsafe_fraction <= cfg.max_unsafe) & (unknown_fraction <= cfg.max_unknown)
    has_good_mean = torch.where(known > 0, mean >= cfg.min_traversability, assumed > 0)
    return FootprintCheck(has_few_bad_cells & has_good_mean, mean, unknown_fraction, unsafe_fraction)


def unsafe_area(
    emap: ElevationMap,
    polygons: Float[Tensor, "B P V 2"],
    cfg: FootprintConfig | None = None,
    *,
    state: MapState | None = None,
) -> list[list[np.ndarray]]:
    """Return the convex hull of the unsafe cells below each footprint.

    The host waits for the device, as the hulls differ in length. Arguments and errors are those of `check_footprint`.

    Returns:
        `[b][p]` -> (K, 2) float64 [m], map frame: the vertices around whole cells, counter-clockwise; (0, 2) where no
        cell is unsafe.
    """
    cfg = given_or_default(FootprintConfig, cfg)
    ground = _read_ground(emap, polygons, cfg, state)
    corner = (emap.state if state is None else state).corner
    unsafe, first = ground.unsafe.cpu().numpy(), (ground.cells.first + corner[:, None]).cpu().numpy()
    return [
        [(convex_hull(cells) + offset) * emap.cfg.grid.resolution for cells, offset in zip(*both, strict=True)]
        for both in zip(unsafe, first, strict=True)
    ]


def _read_ground(
    emap: ElevationMap,
    polygons: Tensor,
    cfg: FootprintConfig,
    state: MapState | None,
    standing: Tensor | None = None,
) -> _Ground:
    """Check the inputs and read the cells below the polygons."""
    is_rated = cfg.layer != "traversability" or emap.cfg.traversability is not None
    hint = "give ElevationMapConfig a TraversabilityConfig, or FootprintConfig another layer"
    require(is_rated, "traversability", "must not be switched off", "None", hint)
    values, known = emap.read_layer(cfg.layer, state)
    uv, is_usable = _to_cells(emap, polygons, cfg, (emap.state if state is None else state).corner)
    cells = rasterize(torch.where(is_usable[..., None, None], uv, 0.0), cfg.max_cells(emap.cfg.grid) + 1)
    cells = cells._replace(inside=cells.inside & is_usable[..., None, None])
    assumed = torch.zeros_like(cells.inside)
    if standing is not None:
        below = mark_standing_cells(emap, standing, state) & ~known
        assumed = _read_patches(values, below, cells, emap.cfg.grid)[1]
    values, known = _read_patches(values, known, cells, emap.cfg.grid)
    return _Ground(cells, values, known, known & (values < cfg.unsafe_traversability), assumed)


def _to_cells(emap: ElevationMap, polygons: Tensor, cfg: FootprintConfig, corner: Tensor) -> tuple[Tensor, Tensor]:
    """Return the vertices in cells from the window's corner, and which polygons are finite and small enough."""
    value = check_tensor("polygons", polygons, emap.device, FLOATS)
    fits = value.ndim == 4 and value.shape[0] == emap.num_envs and value.shape[3] == 2
    hint = "give x and y of polygons for each environment"
    require(fits, "polygons", f"expected ({emap.num_envs}, P, V, 2)", tuple(value.shape), hint)
    hint = "give the vertices in order, or repeat the last one"
    require(value.shape[2] >= 3, "polygons", "must have at least 3 vertices", value.shape[2], hint)
    grid = emap.cfg.grid
    max_extent = cfg.max_cells(grid) + ROUNDING
    uv = value.detach().double() / grid.resolution - corner[:, None, None]
    extent = (uv.amax(-2) - uv.amin(-2)).amax(-1)
    if readable(value, emap.check_values) and value.numel():
        _require_small(uv, extent, max_extent, cfg, grid)
    return uv, (uv.abs() < MAX_CELL_OFFSET).flatten(-2).all(-1) & (extent <= max_extent)


def _require_small(uv: Tensor, extent: Tensor, max_extent: float, cfg: FootprintConfig, grid: GridConfig) -> None:
    """Refuse polygons that are not finite or too large; this reads their values."""
    is_finite = bool(torch.isfinite(uv).all())
    require(is_finite, "polygons", "must be finite", "NaN or inf", "pad by repeating the last vertex, not with NaN")
    largest = float(extent.max())
    rule = f"must extend at most max_extent = {cfg.max_extent:g} m along x and y"
    hint = "enlarge max_extent of FootprintConfig, or divide the polygon"
    require(largest <= max_extent, "polygons", rule, f"{largest * grid.resolution:.6g} m", hint)


def _read_patches(values: Tensor, known: Tensor, cells: PolygonCells, grid: GridConfig) -> tuple[Tensor, Tensor]:
    """Read the polygons' cells: their values, 0 where not known, and where they are known."""
    offset = torch.arange(cells.inside.shape[-1], device=values.device)
    i, j = cells.first[..., 0, None] + offset, cells.first[..., 1, None] + offset
    in_rows, in_columns = (i >= 0) & (i < grid.height), (j >= 0) & (j < grid.width)
    i, j = i.clamp(0, grid.height - 1) * grid.width, j.clamp(0, grid.width - 1)
    cell = (i[..., :, None] + j[..., None, :]).flatten(1)
    is_known = known.flatten(1).gather(1, cell).view_as(cells.inside)
    is_known = is_known & cells.inside & in_rows[..., :, None] & in_columns[..., None, :]
    return torch.where(is_known, values.flatten(1).gather(1, cell).view_as(is_known), 0.0), is_known
