"""Where a robot may walk: its footprint, checked all along a path."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, NamedTuple

import torch
from torch import Tensor

from torchelev.checks import given_or_default, readable
from torchelev.elevation_map import ElevationMap
from torchelev.errors import require, require_count
from torchelev.planning.footprint import FootprintCheck, FootprintConfig, check_footprint
from torchelev.planning.standing import as_xy_yaw, at_poses, check_polygon
from torchelev.state import MapState

if TYPE_CHECKING:
    from jaxtyping import Bool, Float, Int

ROUNDING = 1e-3  # [cells] by which a step may be too long


class PathCheck(NamedTuple):
    """What is known of a path of T poses on each of B maps, at M = (T - 1) * samples + 1 places along it."""

    safe: Bool[Tensor, "B"]  #: every footprint along the path is safe
    first_unsafe: Int[Tensor, "B"]  #: number of the first pose that cannot be reached safely; T: there is none
    poses: Float[Tensor, "B M 3"]  #: x, y [m], map frame, and yaw [rad]; every `samples`-th is one of those given
    footprints: FootprintCheck  #: (B, M), at these places


def check_path(
    emap: ElevationMap,
    poses: Float[Tensor, "B T 3"] | Float[Tensor, "B T 4 4"],
    footprint: Float[Tensor, "V 2"],
    cfg: FootprintConfig | None = None,
    *,
    samples: int = 8,
    standing: Float[Tensor, "B V 2"] | None = None,
    state: MapState | None = None,
) -> PathCheck:
    """Check the footprint at poses and between them, as `check_footprint` does.

    Between two poses the robot moves straight and turns evenly, the shorter way. `samples` footprints are checked for
    each such segment, the last one at its end. No vertex may move farther than one cell from one to the next, so that
    nothing wider than a cell is stepped over.

    Args:
        emap: the maps.
        poses: x, y [m], map frame, and yaw [rad]; or T_map_base, of which the heading counts (`scan_patterns.heading`),
            so that the footprint stays level.
        footprint: a polygon [m], base frame, convex or not.
        cfg: the thresholds.
        samples: how many footprints a segment has. More are needed the farther the poses lie apart.
        standing: footprints on which the robots stand now [m], map frame (`standing.place_footprint`): unknown ground
            under them is assumed to carry the robot, as in `plan`. None: the footprint at the first pose. For a path
            that begins elsewhere, give where the robot is, or NaN to assume nothing.
        state: of the maps; None: their own.

    Raises ValueError or TypeError for inputs that do not fit. Poses that are not finite or too far apart for `samples`
    are refused on a CPU, as is a footprint wider than `max_extent`; on other devices the path is not safe there, unless
    the map has `check_values`.
    """
    cfg = given_or_default(FootprintConfig, cfg)
    given, polygon = as_xy_yaw(emap, poses), check_polygon(emap, footprint)
    if readable(footprint, emap.check_values):
        _refuse_wide(polygon, cfg.max_extent)
    require_count("samples", samples, "give 8")
    shift, turn = given[:, 1:, :2] - given[:, :-1, :2], _shorter_way(given[:, 1:, 2:] - given[:, :-1, 2:])
    reach = torch.linalg.vector_norm(polygon, dim=-1).amax()
    way = torch.linalg.vector_norm(shift, dim=-1) + reach * turn[..., 0].abs()  # of no vertex is it longer
    step = way / (samples * emap.cfg.grid.resolution)
    if readable(poses, emap.check_values):
        _refuse(given, step, samples)
    places = _interpolate(given, torch.cat([shift, turn], -1), samples)
    polygons = at_poses(polygon, places)
    standing = polygons[:, 0] if standing is None else standing
    footprints = check_footprint(emap, polygons, cfg, standing=standing, state=state)
    near = (step <= 1 + ROUNDING).repeat_interleave(samples, 1)
    safe = footprints.safe & torch.cat([near.new_ones(len(near), 1), near], 1)
    return PathCheck(safe.all(1), _first_unsafe(safe, samples), places, footprints._replace(safe=safe))


def _refuse_wide(footprint: Tensor, max_extent: float) -> None:
    """Refuse a footprint that may not fit `max_extent` at some heading; this reads its values."""
    widest = float(torch.pdist(footprint).max())
    rule = f"must be no wider than max_extent = {max_extent:g} m at any heading"
    require(widest <= max_extent * (1 + 1e-6), "footprint", rule, f"{widest:.6g} m", "enlarge it in FootprintConfig")


def _refuse(given: Tensor, step: Tensor, samples: int) -> None:
    """Refuse poses that are not finite or too far apart; this reads their values."""
    finite = bool(torch.isfinite(given).all())
    require(finite, "poses", "must be finite", "NaN or inf", "pad by repeating the last pose, not with NaN")
    longest = float(step.max()) if step.numel() else 0.0
    rule = "must not take the footprint farther than one cell from sample to sample"
    hint = f"raise samples to {math.ceil(samples * longest)}, or give poses in between"
    require(longest <= 1 + ROUNDING, "poses", rule, f"{longest:.3g} cells", hint)


def _shorter_way(turn: Tensor) -> Tensor:
    return torch.remainder(turn + math.pi, 2 * math.pi) - math.pi


def _interpolate(given: Tensor, change: Tensor, samples: int) -> Float[Tensor, "B M 3"]:
    """Return `samples` poses for each segment, from its start on, and the last pose."""
    share = torch.arange(samples, device=given.device, dtype=given.dtype)[:, None] / samples
    # Zero times NaN would reach the pose before.
    between = given[:, :-1, None] + share * torch.nan_to_num(change, 0.0, 0.0, 0.0)[:, :, None]
    return torch.cat([between.flatten(1, 2), given[:, -1:]], 1)


def _first_unsafe(safe: Bool[Tensor, "B M"], samples: int) -> Int[Tensor, "B"]:
    """Return the number of the first pose that is unsafe or comes after something unsafe; of none, one more."""
    sample = torch.arange(safe.shape[1], device=safe.device)
    pose = torch.div(sample + samples - 1, samples, rounding_mode="floor")
    return torch.where(safe, pose[-1] + 1, pose).amin(1)
