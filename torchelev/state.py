"""The two values that flow through the stages: what the map holds and what one scan says."""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING, NamedTuple

import torch
from torch import Tensor

from torchelev.ops.transforms import is_readable

if TYPE_CHECKING:
    from jaxtyping import Bool, Float, Int, UInt8

    from torchelev.grid import GridConfig


class Statistics(NamedTuple):
    """What the last update did, per environment. Counts are int64 (B,), heights are [m] (B,)."""

    points_used: Int[Tensor, "B"]  #: points fused into a cell's height
    rejected_invalid: Int[Tensor, "B"]  #: points that are NaN or inf
    rejected_range: Int[Tensor, "B"]  #: points outside the sensor's distance limits
    rejected_body: Int[Tensor, "B"]  #: points on the robot itself
    rejected_overhang: Int[Tensor, "B"]  #: points above the exclusion ramp, or on a surface other than the ground
    rejected_outside: Int[Tensor, "B"]  #: points outside the window
    rejected_outlier: Int[Tensor, "B"]  #: points outside the Mahalanobis gate
    rejected_edge: Int[Tensor, "B"]  #: points on the wrong side of a step within their cell
    drift_points: Int[Tensor, "B"]  #: points that measured the height drift
    drift_error: Float[Tensor, "B"]  #: [m] mean height error of these points
    drift_correction: Float[Tensor, "B"]  #: [m] added to the map's heights
    #: [m] height difference between sensors or successive scans; its square is part of every variance
    disagreement: Float[Tensor, "B"]
    cleared_seen_through: Int[Tensor, "B"]  #: cells that visibility clean-up removed
    cleared_other_floors: Int[Tensor, "B"]  #: cells that overlap clearance removed
    cells_bounded: Int[Tensor, "B"]  #: unknown cells that have an upper bound


class MapState(NamedTuple):
    """B robot-centric maps. No NaN: a value counts only where its mask says so."""

    corner: Int[Tensor, "B 2"]  #: cell numbers of [..., 0, 0] on the lattice of the map frame
    base_height: Float[Tensor, "B"]  #: [m] z of the last T_map_base
    pose_covariance: Float[Tensor, "B 3 3"]  #: [m^2] of the position that all elevations refer to; see `pose_error`
    elapsed: Int[Tensor, "B"]  #: [ns] sum of all dt since the reset; a cell's last hit was at elapsed * 1e-9 - time [s]
    elevation: Float[Tensor, "B H W"]  #: [m] map frame
    variance: Float[Tensor, "B H W"]  #: [m^2]
    validity: Bool[Tensor, "B H W"]  #: whether the elevation is known
    support: Float[Tensor, "B H W"]  #: points that agree minus points that disagree
    challenger: Float[Tensor, "B H W"]  #: [m] lowest height that contradicts the elevation from above; no gradient
    challenger_support: UInt8[Tensor, "B H W"]  #: points that agree with the challenger minus points that do not
    time: Float[Tensor, "B H W"]  #: [s] time since the last hit; constant in unknown cells
    upper_bound: Float[Tensor, "B H W"]  #: [m] upper bound of unknown cells
    bounded: Bool[Tensor, "B H W"]  #: whether upper_bound is known; in known cells only until `clear_seen_through`
    gradient_x: Float[Tensor, "B H W"]  #: dz/dx
    gradient_y: Float[Tensor, "B H W"]  #: dz/dy
    has_normal: Bool[Tensor, "B H W"]  #: whether the known neighbours span a plane; elsewhere the gradient is 0
    traversability: Float[Tensor, "B H W"]  #: in [0, 1]
    rated: Bool[Tensor, "B H W"]  #: whether known cells span the head's window; elsewhere traversability is 0
    statistics: Statistics  #: of the last update


class Measurement(NamedTuple):
    """One instant's points of S sensors in the map frame, M = S * N. Made by `stages.measure`.

    Horizontal coordinates count from `anchor`, so that float32 keeps them exact far from the origin.
    """

    anchor: Int[Tensor, "B 2"]  #: cell number that x = y = 0 below stands for
    points: Float[Tensor, "B M 3"]  #: [m] zero where ignored
    variance: Float[Tensor, "B M"]  #: [m^2] of each height
    used: Bool[Tensor, "B M"]  #: measures the ground
    casts: Bool[Tensor, "B M"]  #: its ray clears and bounds (points rejected as overhang do)
    origin: Float[Tensor, "B S 3"]  #: [m] the sensors
    base: Float[Tensor, "B 3"] | None  #: [m] the robot; None, or NaN in one environment: the window stays
    dt: Float[Tensor, "B"]  #: [s]
    rejected_invalid: Int[Tensor, "B"]  #: see `Statistics`
    rejected_range: Int[Tensor, "B"]  #: see `Statistics`
    rejected_body: Int[Tensor, "B"]  #: see `Statistics`
    rejected_overhang: Int[Tensor, "B"]  #: see `Statistics`
    noise: Float[Tensor, "B M"] | None = None  #: [m^2] of the variance, what the pose does not add; None: all of it
    pose_covariance: Float[Tensor, "B 3 3"] | None = None  #: [m^2] of the first sensor's position
    moving: Bool[Tensor, "B"] | None = None  #: the robot moves, and its height may drift; None: all do


LAYERS = MapState._fields[4:-1]  # (B, H, W)
MASKS = ("validity", "bounded", "has_normal", "rated")  # layers that are true or false
CARRIED = ("drift_correction", "disagreement")  # statistics that the next update reads
# What a cell that was never known holds, by layer; everything else is zero.
BLANK = {"variance": 1.0}


def blank_corner(grid: GridConfig) -> tuple[int, int]:
    """Return the corner of a window centred on the map frame's origin."""
    return -(grid.height // 2), -(grid.width // 2)


def blank_state(grid: GridConfig, num_envs: int, device: torch.device | str, dtype: torch.dtype) -> MapState:
    """Return B maps of which nothing is known, centred on the map frame's origin."""
    layer = torch.zeros(num_envs, grid.height, grid.width, device=device, dtype=dtype)
    number = torch.zeros(num_envs, device=device, dtype=dtype)
    zero = torch.zeros(num_envs, device=device, dtype=torch.int64)
    corner = torch.stack([zero + cells for cells in blank_corner(grid)], -1)
    heights = {"drift_error", "drift_correction", "disagreement"}
    kinds = dict.fromkeys(MASKS, torch.bool) | {"challenger_support": torch.uint8}
    values = {name: (layer + BLANK.get(name, 0.0)).to(kinds.get(name, dtype)) for name in LAYERS}
    statistics = Statistics(*(number.clone() if f in heights else zero.clone() for f in Statistics._fields))
    covariance = number.new_zeros(num_envs, 3, 3)
    own = dict(corner=corner, base_height=number, pose_covariance=covariance, elapsed=zero)
    return MapState(**own, statistics=statistics, **values)


def forget(state: MapState, grid: GridConfig, env_ids: Tensor | None, mask: Tensor | None) -> None:
    """Make some environments of a state blank, in place: those of the ids or of the mask, or all."""
    if mask is not None and is_readable(mask):
        env_ids, mask = mask.nonzero()[:, 0], None  # mostly few: a mask would be read for every cell of all
    for name, value in (state._asdict() | state.statistics._asdict()).items():
        if name not in ("corner", "statistics"):
            fill(value, BLANK.get(name, 0), env_ids, mask)
    for corner, number in zip(state.corner.unbind(1), blank_corner(grid), strict=True):
        fill(corner, number, env_ids, mask)


def fill(values: Tensor, blank: float, env_ids: Tensor | None, mask: Tensor | None) -> None:
    """Set the values (B, ...) of some environments, in place: those of the ids or of the mask, or all."""
    if env_ids is not None:
        values.index_fill_(0, env_ids, blank)
    elif mask is not None:
        values.masked_fill_(mask.view(-1, *[1] * (values.ndim - 1)), blank)
    else:
        values.fill_(blank)


def forget_cells(state: MapState, cells: Bool[Tensor, "B H W"]) -> MapState:
    """Return the state with these cells blank, as if they had never been known."""
    blank = {name: getattr(state, name).masked_fill(cells, BLANK.get(name, 0)) for name in LAYERS}
    return state._replace(**blank)  # type: ignore[arg-type]


def map_layers(function: Callable[..., Tensor], *states: MapState) -> MapState:
    """Apply a function to each tensor of a state, or to the same tensor of several states."""
    layers = {n: function(*(getattr(state, n) for state in states)) for n in MapState._fields[:-1]}
    counts = {n: function(*(getattr(state.statistics, n) for state in states)) for n in Statistics._fields}
    return MapState(statistics=Statistics(**counts), **layers)


def tally(state: MapState, **counts: Tensor) -> MapState:
    """Return the state with these statistics replaced."""
    return state._replace(statistics=state.statistics._replace(**counts))
