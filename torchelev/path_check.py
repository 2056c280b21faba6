"""Where a robot may walk: its footprint, checked all along a path."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, NamedTuple

import torch
from torch import Tensor

from torchelev.checks import FLOATS, check_pose, check_tensor, given_or_default, readable
from torchelev.elevation_map import ElevationMap
from torchelev.errors import require, require_count
from torchelev.footprint import FootprintCheck, FootprintConfig, check_footprint
from torchelev.scan_patterns import heading
from torchelev.state import MapState

if TYPE_CHECKING:
    from jaxtyping import Bool, Float, Int

ROUNDING = 1e-3  # [cells] by which a step may be too long


class PathCheck(NamedTuple):
    """What is known of a path of T poses on each of B maps, at M = (T - 1) * samples + 1 places along it."""

    safe: Bool[Tensor, "B"]
    first_unsafe: Int[Tensor, "B"]  # number of the first pose that cannot be reached safely; T: there is none
    poses: Float[Tensor, "B M 3"]  # x, y [m], map frame, and yaw [rad]; every `samples`-th is one of those given
    footprints: FootprintCheck  # (B, M), at these places


def check_path(
    emap: ElevationMap,
    poses: Float[Tensor, "B T 3"] | Float[Tensor, "B T 4 4"],
    footprint: Float[Tensor, "V 2"],
    cfg: FootprintConfig | None = None,
    *,
    samples: int = 8,
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
        state: of the maps; None: their own.

    Raises ValueError or TypeError for inputs that do not fit. Poses that are not finite or too far apart for `samples`
    are refused on a CPU, as is a footprint wider than `max_extent`; on other devices the path is not safe there, unless
    the map has `check_values`.
    """
    cfg = given_or_default(FootprintConfig, cfg)
    given = _as_xy_yaw(emap, poses)
    footprint = _check_polygon(emap, footprint, cfg.max_extent)
    require_count("samples", samples, "give 8")
    shift, turn = given[:, 1:, :2] - given[:, :-1, :2], _shorter_way(given[:, 1:, 2:] - given[:, :-1, 2:])
    reach = torch.linalg.vector_norm(footprint, dim=-1).amax()
    way = torch.linalg.vector_norm(shift, dim=-1) + reach * turn[..., 0].abs()  # of no vertex is it longer
    step = way / (samples * emap.cfg.grid.resolution)
    if readable(poses, emap.check_values):
        _refuse(given, step, samples)
    places = _interpolate(given, torch.cat([shift, turn], -1), samples)
    footprints = check_footprint(emap, _place(footprint, places), cfg, state=state)
    near = (step <= 1 + ROUNDING).repeat_interleave(samples, 1)
    safe = footprints.safe & torch.cat([near.new_ones(len(near), 1), near], 1)
    return PathCheck(safe.all(1), _first_unsafe(safe, samples), places, footprints._replace(safe=safe))


def _as_xy_yaw(emap: ElevationMap, poses: object) -> Float[Tensor, "B T 3"]:
    """Check the poses and return them in float64."""
    value = check_tensor("poses", poses, emap.device, FLOATS)
    shape = tuple(value.shape)
    fits = shape[:1] == (emap.num_envs,) and len(shape) > 1 and shape[1] >= 1 and shape[2:] in ((3,), (4, 4))
    rule = f"expected ({emap.num_envs}, T, 3) or ({emap.num_envs}, T, 4, 4) with T >= 1"
    require(fits, "poses", rule, shape, "give x, y, yaw, or 4 x 4 matrices")
    if value.ndim == 3:
        return value.detach().double()
    T_map_base = check_pose("poses", value, shape, emap.device, emap.check_values).detach().double()
    x, y = heading(T_map_base.flatten(0, 1)).unbind(-1)
    return torch.cat([T_map_base[..., :2, 3], torch.atan2(y, x).view(*shape[:2], 1)], -1)


def _check_polygon(emap: ElevationMap, footprint: object, most: float) -> Float[Tensor, "V 2"]:
    value = check_tensor("footprint", footprint, emap.device, FLOATS)
    fits = value.ndim == 2 and value.shape[0] >= 3 and value.shape[1] == 2
    require(fits, "footprint", "expected (V, 2) with V >= 3", tuple(value.shape), "give its corners, base frame")
    if readable(value, emap.check_values):
        finite = bool(torch.isfinite(value).all())
        require(finite, "footprint", "must be finite", "NaN or inf", "leave those vertices out")
        widest = float(torch.pdist(value.detach().double()).max())
        rule = f"must be no wider than max_extent = {most:g} m at any heading"
        require(widest <= most * (1 + 1e-6), "footprint", rule, f"{widest:.6g} m", "enlarge it in FootprintConfig")
    return value.detach().double()


def _refuse(given: Tensor, step: Tensor, samples: int) -> None:
    """Refuse poses that are not finite or too far apart; this reads their values."""
    finite = bool(torch.isfinite(given).all())
    require(finite, "poses", "must be finite", "NaN or inf", "pad by repeating the last pose, not with NaN")
    longest = float(step.max()) if step.numel() else 0.0
    rule = "must not take the footprint farther than one cell from sample to sample"
    mend = f"raise samples to {math.ceil(samples * longest)}, or give poses in between"
    require(longest <= 1 + ROUNDING, "poses", rule, f"{longest:.3g} cells", mend)


def _shorter_way(turn: Tensor) -> Tensor:
    return torch.remainder(turn + math.pi, 2 * math.pi) - math.pi


def _interpolate(given: Tensor, change: Tensor, samples: int) -> Float[Tensor, "B M 3"]:
    """Return `samples` poses for each segment, from its start on, and the last pose."""
    share = torch.arange(samples, device=given.device, dtype=given.dtype)[:, None] / samples
    # Zero times NaN would reach the pose before.
    between = given[:, :-1, None] + share * torch.nan_to_num(change, 0.0, 0.0, 0.0)[:, :, None]
    return torch.cat([between.flatten(1, 2), given[:, -1:]], 1)


def _place(footprint: Float[Tensor, "V 2"], places: Float[Tensor, "B M 3"]) -> Float[Tensor, "B M V 2"]:
    """Return the footprint at each place, map frame."""
    position, yaw = places[..., None, :2], places[..., 2:]
    ahead = torch.stack([yaw.cos(), yaw.sin()], -1)
    left = torch.stack([-yaw.sin(), yaw.cos()], -1)
    return position + footprint[:, :1] * ahead + footprint[:, 1:] * left


def _first_unsafe(safe: Bool[Tensor, "B M"], samples: int) -> Int[Tensor, "B"]:
    """Return the number of the first pose that is unsafe or comes after something unsafe; of none, one more."""
    sample = torch.arange(safe.shape[1], device=safe.device)
    pose = torch.div(sample + samples - 1, samples, rounding_mode="floor")
    return torch.where(safe, pose[-1] + 1, pose).amin(1)
