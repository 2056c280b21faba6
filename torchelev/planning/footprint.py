"""Where a robot may stand: footprints as polygons, checked against the traversability of the cells below them."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
import torch
from torch import Tensor

from torchelev.checks import FLOATS, check_tensor, given_or_default, readable
from torchelev.elevation_map import ElevationMap
from torchelev.errors import require, require_positive
from torchelev.grid import GridConfig
from torchelev.planning.polygons import PolygonCells, convex_hull, polygon_cells
from torchelev.planning.standing import FARTHEST_CELLS, standing_cells
from torchelev.state import MapState

if TYPE_CHECKING:
    from jaxtyping import Bool, Float

ROUNDING = 1e-3  # [cells] by which a polygon may extend too far


@dataclass(frozen=True, kw_only=True)
class FootprintConfig:
    """What is asked of the ground below a footprint. Shares are of all the cells in the polygon.

    The defaults are meant for the analytic head, whose 0.5 is a slope of 20 degrees, a step of 10 cm or a roughness of
    2.5 cm, and whose 0.3 is 28 degrees, 14 cm or 3.5 cm. The learned head says of each cell whether the body may stand
    over it: for that, give polygons of where the body's centre may be instead of the body's own.
    """

    layer: str = "traversability"  #: 0 to 1, the better
    min_traversability: float = 0.5  #: mean over the known cells, at least
    unsafe_traversability: float = 0.3  #: a cell below it is unsafe
    max_unsafe: float = 0.05  #: share of unsafe cells, at most
    max_unknown: float = 0.2  #: share of cells that are unknown or outside of the window, at most
    max_extent: float = 1.5  #: [m] of a polygon along x and y, at most: the cost grows with its square

    def __post_init__(self) -> None:
        for name in ("min_traversability", "unsafe_traversability", "max_unsafe", "max_unknown"):
            value = getattr(self, name)
            number = isinstance(value, int | float) and not isinstance(value, bool)
            good = number and 0 <= value <= 1
            require(good, f"footprint.{name}", "must lie in [0, 1]", repr(value), "leave it out for its default")
        require_positive(**{"footprint.max_extent": self.max_extent})

    def cells(self, grid: GridConfig) -> int:
        """Return how many cells a polygon may extend along x and y."""
        return math.ceil(self.max_extent / grid.resolution - 1e-6)


class FootprintCheck(NamedTuple):
    """What is known of P footprints on each of B maps. Means and shares are 0 to 1."""

    safe: Bool[Tensor, "B P"]  #: nothing known, or required to be known, forbids the footprint
    traversability: Float[Tensor, "B P"]  #: mean over the known cells, 0 where none is
    unknown: Float[Tensor, "B P"]  #: share of cells that are unknown or outside of the window, and not `assumed`
    unsafe: Float[Tensor, "B P"]  #: share of cells that are known to be unsafe


class _Ground(NamedTuple):
    """The cells below footprints."""

    cells: PolygonCells
    values: Float[Tensor, "B P S S"]  # 0 where not known
    known: Bool[Tensor, "B P S S"]  # in the polygon, and known
    unsafe: Bool[Tensor, "B P S S"]
    assumed: Bool[Tensor, "B P S S"]  # in the polygon, unknown, and under the robot where it stands now


def check_footprint(
    emap: ElevationMap,
    polygons: Float[Tensor, "B P V 2"],
    cfg: FootprintConfig | None = None,
    *,
    standing: Float[Tensor, "B V 2"] | None = None,
    state: MapState | None = None,
) -> FootprintCheck:
    """Check whether footprints lie on ground that carries the robot.

    Safe means: the mean traversability is high enough, and the shares of unsafe and of unknown cells are low enough, by
    the config. Known means that the layer has a value: ground of known elevation but unknown traversability is unknown.
    A polygon below which nothing is known is safe only where the robot stands. The mean is differentiable in the state.

    Args:
        emap: the maps.
        polygons: their vertices [m], map frame, convex or not, either way around. Pad those with fewer vertices by
            repeating their last one. The cells whose centres lie inside count (even-odd rule); of a polygon too small
            or too narrow to hold a centre, those that its boundary passes.
        cfg: the thresholds.
        standing: footprints on which the robots stand now [m], map frame (`standing.place_footprint`): unknown cells
            under them are assumed to carry the robot. They count neither as unknown nor towards the mean; known cells
            count as everywhere. None, or NaN: nothing is assumed.
        state: of the maps; None: their own.

    The paper's open code offers planners such a check. It cuts polygons off at the window's border and asks nothing of
    unknown cells, where here both count as unknown; and it bounds the number of unsafe cells, not their share.

    Raises ValueError or TypeError for wrong shapes, dtypes and devices, fewer than 3 vertices, and a map whose
    traversability is switched off; KeyError for an unknown layer. Polygons with NaN or inf, and those larger than
    `max_extent` (rounded up to whole cells), are refused on a CPU. On other devices, where looking would make the host
    wait, they are not safe and nothing is known of them, unless the map has `check_values`.
    """
    cfg = given_or_default(FootprintConfig, cfg)
    ground = _ground(emap, polygons, cfg, state, standing)
    values = ground.values
    masks = (ground.cells.inside, ground.known, ground.unsafe, ground.assumed)
    counted, known, unsafe, assumed = (mask.flatten(-2).sum(-1, dtype=torch.int32) for mask in masks)
    mean = values.flatten(-2).sum(-1) / known.clamp(min=1).to(values.dtype)
    number = counted.clamp(min=1).double()
    share_unknown = torch.where(counted > 0, (counted - known - assumed) / number, 1.0).to(values.dtype)
    share_unsafe = (unsafe / number).to(values.dtype)
    few = (share_unsafe <= cfg.max_unsafe) & (share_unknown <= cfg.max_unknown)
    good = torch.where(known > 0, mean >= cfg.min_traversability, assumed > 0)
    return FootprintCheck(few & good, mean, share_unknown, share_unsafe)


def unsafe_area(
    emap: ElevationMap,
    polygons: Float[Tensor, "B P V 2"],
    cfg: FootprintConfig | None = None,
    *,
    state: MapState | None = None,
) -> list[list[np.ndarray]]:
    """Return the convex hull of each footprint's unsafe cells: [b][p] -> (K, 2) float64 [m], map frame.

    Counter-clockwise, the first vertex not repeated, around whole cells; (0, 2) where no cell is unsafe. The hulls
    differ in length, so they are made on the host, which waits for the device. Inputs and errors as of
    `check_footprint`.
    """
    cfg = given_or_default(FootprintConfig, cfg)
    ground = _ground(emap, polygons, cfg, state)
    corner = (emap.state if state is None else state).corner
    marks, first = ground.unsafe.cpu().numpy(), (ground.cells.first + corner[:, None]).cpu().numpy()
    return [
        [(convex_hull(cells) + at) * emap.cfg.grid.resolution for cells, at in zip(*both, strict=True)]
        for both in zip(marks, first, strict=True)
    ]


def _ground(
    emap: ElevationMap,
    polygons: Tensor,
    cfg: FootprintConfig,
    state: MapState | None,
    standing: Tensor | None = None,
) -> _Ground:
    """Check the inputs and read the cells below the polygons."""
    rated = cfg.layer != "traversability" or emap.cfg.traversability is not None
    hint = "give ElevationMapConfig a TraversabilityConfig, or FootprintConfig another layer"
    require(rated, "traversability", "must not be switched off", "None", hint)
    values, known = emap.read_layer(cfg.layer, state)
    uv, fits = _locate(emap, polygons, cfg, (emap.state if state is None else state).corner)
    cells = polygon_cells(torch.where(fits[..., None, None], uv, 0.0), cfg.cells(emap.cfg.grid) + 1)
    cells = cells._replace(inside=cells.inside & fits[..., None, None])
    assumed = torch.zeros_like(cells.inside)
    if standing is not None:
        below = standing_cells(emap, standing, state) & ~known
        assumed = _gather(values, below, cells, emap.cfg.grid)[1]
    values, known = _gather(values, known, cells, emap.cfg.grid)
    return _Ground(cells, values, known, known & (values < cfg.unsafe_traversability), assumed)


def _locate(emap: ElevationMap, polygons: Tensor, cfg: FootprintConfig, corner: Tensor) -> tuple[Tensor, Tensor]:
    """Return the vertices in cells from the window's corner, and which polygons are finite and small enough."""
    value = check_tensor("polygons", polygons, emap.device, FLOATS)
    shaped = value.ndim == 4 and value.shape[0] == emap.num_envs and value.shape[3] == 2
    hint = "give polygons for each environment, x and y alone"
    require(shaped, "polygons", f"expected ({emap.num_envs}, P, V, 2)", tuple(value.shape), hint)
    hint = "give the corners in order, or repeat the last one"
    require(value.shape[2] >= 3, "polygons", "must have at least 3 vertices", value.shape[2], hint)
    grid = emap.cfg.grid
    most = cfg.cells(grid) + ROUNDING
    uv = value.detach().double() / grid.resolution - corner[:, None, None]
    extent = (uv.amax(-2) - uv.amin(-2)).amax(-1)
    if readable(value, emap.check_values) and value.numel():
        _refuse(uv, extent, most, cfg, grid)
    return uv, (uv.abs() < FARTHEST_CELLS).flatten(-2).all(-1) & (extent <= most)


def _refuse(uv: Tensor, extent: Tensor, most: float, cfg: FootprintConfig, grid: GridConfig) -> None:
    """Refuse polygons that are not finite or too large; this reads their values."""
    finite = bool(torch.isfinite(uv).all())
    require(finite, "polygons", "must be finite", "NaN or inf", "pad by repeating the last vertex, not with NaN")
    largest = float(extent.max())
    rule = f"must extend no farther than max_extent = {cfg.max_extent:g} m along x and y"
    hint = "enlarge max_extent of FootprintConfig, or divide the polygon"
    require(largest <= most, "polygons", rule, f"{largest * grid.resolution:.6g} m", hint)


def _gather(values: Tensor, known: Tensor, cells: PolygonCells, grid: GridConfig) -> tuple[Tensor, Tensor]:
    """Read the polygons' cells: their values, 0 where not known, and where they are known."""
    steps = torch.arange(cells.inside.shape[-1], device=values.device)
    i, j = cells.first[..., 0, None] + steps, cells.first[..., 1, None] + steps
    rows, columns = (i >= 0) & (i < grid.height), (j >= 0) & (j < grid.width)
    i, j = i.clamp(0, grid.height - 1) * grid.width, j.clamp(0, grid.width - 1)
    cell = (i[..., :, None] + j[..., None, :]).flatten(1)
    found = known.flatten(1).gather(1, cell).view_as(cells.inside)
    found = found & cells.inside & rows[..., :, None] & columns[..., None, :]
    return torch.where(found, values.flatten(1).gather(1, cell).view_as(found), 0.0), found
