"""Check where a robot may walk: its footprint all along a path."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, NamedTuple

import torch
from torch import Tensor

from torchelev.elevation_map import ElevationMap
from torchelev.errors import require, require_count
from torchelev.inputs.checks import given_or_default
from torchelev.levels.config import needed_height
from torchelev.ops.transforms import is_readable
from torchelev.planning.footprint import FootprintCheck, FootprintConfig, check_footprint
from torchelev.planning.limits import Limits, limits_of
from torchelev.planning.standing import MAX_CELL_OFFSET, check_polygon, check_poses, transform_polygon
from torchelev.planning.terrain.ceilings import describe_ceiling
from torchelev.state import MapState

if TYPE_CHECKING:
    from jaxtyping import Bool, Float, Int

ROUNDING = 1e-3  # [cells] tolerance on the distance between samples


class PathCheck(NamedTuple):
    """Ratings of a path of T poses on each of B maps, sampled at M = (T - 1) * samples + 1 places."""

    safe: Bool[Tensor, "B"]  #: every footprint along the path is safe; False for an empty path
    first_unsafe: Int[Tensor, "B"]  #: index of the first pose that cannot be reached safely; T if all can
    poses: Float[Tensor, "B M 3"]  #: x, y [m] and yaw [rad], map frame; every `samples`-th is a given pose
    footprints: FootprintCheck  #: (B, M), at these places
    limits: Limits  #: of the robot, which hold besides the thresholds
    height: float = 0.0  #: [m] clearance that the robot needs below ceilings; 0 on maps without levels

    def explain(self) -> list[str]:
        """Say for each path whether it is safe, else why not. The host waits for the device.

        A path that is not safe although the numbers meet the thresholds has poses too far apart for `samples`.
        """
        columns = (self.safe, _is_empty(self.poses), self.first_unsafe, self.footprints.safe.to(torch.uint8).argmin(1))
        rows = zip(*(column.tolist() for column in columns), strict=True)
        return [self._explain(b, *row) for b, row in enumerate(rows)]

    def _explain(self, b: int, is_safe: bool, is_empty: bool, pose: int, sample: int) -> str:
        if is_safe:
            return "every footprint along the path is safe"
        if is_empty:
            return "the path is empty: no path was found; Path.explain() says why"
        x, y, _ = self.poses[b, sample].tolist()
        mean, unknown, unsafe, *asked, ceiling, _ = (float(values[b, sample]) for values in self.footprints[1:])
        ground = f"mean traversability {mean:.2f}, {unsafe:.0%} of the cells unsafe, {unknown:.0%} unknown"
        ground = "; ".join([*self.limits.describe(*asked), *describe_ceiling(ceiling, self.height), ground])
        return f"pose {pose} cannot be reached safely: at x = {x:.2f} m, y = {y:.2f} m {ground}"


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
    """Check a footprint at poses and between them, with `check_footprint`.

    Between two poses the robot moves straight and turns evenly, the shorter way around. `samples` footprints are
    checked on each such segment, the last one at its end. From one sample to the next, each vertex may move by one
    cell at most, so that no obstacle wider than a cell is stepped over.

    A path whose poses x, y, yaw are all NaN is empty, as `Path.poses` returns it where `plan` found no path: it is not
    safe, and pose 0 is the first unsafe one. Pad other paths by repeating the last pose.

    Args:
        emap: the maps.
        poses: x, y [m] and yaw [rad], map frame; or T_map_base, of which the position and the heading
            (`observations.patterns.compute_heading`) are used: the footprint stays level.
        footprint: vertices of a polygon [m], base frame, convex or not.
        cfg: the thresholds.
        samples: footprints on each segment. Give more for poses that lie farther apart.
        standing: footprints on which the robots stand now [m], map frame (`standing.place_footprint`). Unknown cells
            below them are assumed to be passable, as in `plan`. None: the footprint at the first pose. For a path that
            starts elsewhere give the robot's place, or NaN to assume nothing.
        state: the state to read; None: that of the maps.

    Raises:
        ValueError, TypeError: for a wrong shape, dtype or device. On a CPU, or with the map's `check_values`, also for
            poses that are not finite, poses too far apart for `samples`, and a footprint wider than `max_extent`;
            elsewhere, where reading them would make the host wait, such places are not safe.
    """
    cfg = given_or_default(FootprintConfig, cfg)
    given, polygon = check_poses(emap, poses), check_polygon(emap, footprint)
    if is_readable(footprint, emap.check_values):
        _require_fits(polygon, cfg.max_extent)
    require_count("samples", samples, "give 8")
    is_empty = _is_empty(given)
    change = _find_changes(given)
    step = _find_cells(change, polygon, emap.cfg.grid.resolution) / samples
    step = torch.where(is_empty[:, None], 0.0, step)
    if is_readable(poses, emap.check_values):
        _require_close(torch.where(is_empty[:, None, None], 0.0, given), step, samples)
    places = _interpolate(given, change, samples)
    # An empty path lies nowhere: so far away that nothing is known.
    nowhere = 2 * MAX_CELL_OFFSET * emap.cfg.grid.resolution
    polygons = torch.where(is_empty[:, None, None, None], nowhere, transform_polygon(polygon, places))
    standing = polygons[:, 0] if standing is None else standing
    footprints = check_footprint(emap, polygons, cfg, standing=standing, state=state)
    is_close = (step <= 1 + ROUNDING).repeat_interleave(samples, 1)
    safe = footprints.safe & torch.cat([is_close.new_ones(len(is_close), 1), is_close], 1)
    first_unsafe = _find_first_unsafe(safe, samples)
    footprints, height = footprints._replace(safe=safe), needed_height(emap.cfg.levels, cfg.height)
    return PathCheck(safe.all(1), first_unsafe, places, footprints, limits_of(emap.cfg), height)


def count_samples(
    emap: ElevationMap, poses: Float[Tensor, "B T 3"] | Float[Tensor, "B T 4 4"], footprint: Float[Tensor, "V 2"]
) -> int:
    """Return the fewest `samples` with which `check_path` takes these poses. The host waits for the device.

    Raises:
        ValueError, TypeError: for a wrong shape, dtype or device.
    """
    given, polygon = check_poses(emap, poses), check_polygon(emap, footprint)
    cells = _find_cells(_find_changes(given), polygon, emap.cfg.grid.resolution)
    return max(1, math.ceil(float(cells.max()))) if cells.numel() else 1


def _find_changes(given: Float[Tensor, "B T 3"]) -> Float[Tensor, "B T-1 3"]:
    """Return the shift [m] and the shorter turn [rad] from each pose to the next."""
    change = given[:, 1:] - given[:, :-1]
    return torch.cat([change[..., :2], _wrap_angle(change[..., 2:])], -1)


def _find_cells(change: Tensor, polygon: Tensor, resolution: float) -> Float[Tensor, "B T-1"]:
    """Return how many cells a vertex moves at most: no farther than the base does and the farthest vertex turns."""
    radius = torch.linalg.vector_norm(polygon, dim=-1).amax()
    return (torch.linalg.vector_norm(change[..., :2], dim=-1) + radius * change[..., 2].abs()) / resolution


def _is_empty(poses: Float[Tensor, "B T 3"]) -> Bool[Tensor, "B"]:
    return torch.isnan(poses).flatten(1).all(1)


def _require_fits(footprint: Tensor, max_extent: float) -> None:
    """Refuse a footprint that is larger than `max_extent` at some heading; this reads its values."""
    width = float(torch.pdist(footprint).max())
    rule = f"must be no wider than max_extent = {max_extent:g} m at any heading"
    require(width <= max_extent * (1 + 1e-6), "footprint", rule, f"{width:.6g} m", "enlarge it in FootprintConfig")


def _require_close(given: Tensor, step: Tensor, samples: int) -> None:
    """Refuse poses that are not finite or too far apart; this reads their values."""
    is_finite = bool(torch.isfinite(given).all())
    require(is_finite, "poses", "must be finite", "NaN or inf", "pad by repeating the last pose, not with NaN")
    longest = float(step.max()) if step.numel() else 0.0
    rule = "must not move the footprint by more than one cell from sample to sample"
    hint = f"raise samples to {math.ceil(samples * longest)}, or give poses in between"
    require(longest <= 1 + ROUNDING, "poses", rule, f"{longest:.3g} cells", hint)


def _wrap_angle(angle: Tensor) -> Tensor:
    """Wrap an angle [rad] to [-pi, pi)."""
    return torch.remainder(angle + math.pi, 2 * math.pi) - math.pi


def _interpolate(given: Tensor, change: Tensor, samples: int) -> Float[Tensor, "B M 3"]:
    """Return `samples` poses for each segment, its start included, and the last pose."""
    fraction = torch.arange(samples, device=given.device, dtype=given.dtype)[:, None] / samples
    # 0 * NaN would make the pose before it NaN.
    between = given[:, :-1, None] + fraction * torch.nan_to_num(change, 0.0, 0.0, 0.0)[:, :, None]
    return torch.cat([between.flatten(1, 2), given[:, -1:]], 1)


def _find_first_unsafe(safe: Bool[Tensor, "B M"], samples: int) -> Int[Tensor, "B"]:
    """Return the index of the first pose at or behind an unsafe sample; the number of poses if all are safe."""
    sample = torch.arange(safe.shape[1], device=safe.device)
    pose = torch.div(sample + samples - 1, samples, rounding_mode="floor")
    return torch.where(safe, pose[-1] + 1, pose).amin(1)
