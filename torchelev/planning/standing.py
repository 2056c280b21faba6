"""The ground under a robot where it stands now: unknown cells there are assumed to be passable.

A robot's sensors rarely see the ground below its body. `plan`, `check_path` and `check_footprint` share one rule: as
the robot stands there, unknown traversability under its present footprint counts as passable. Known cells there, and
all cells that the footprint reaches later, are rated as everywhere else.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import torch
from torch import Tensor

from torchelev.elevation_map import ElevationMap
from torchelev.errors import require
from torchelev.inputs.checks import FLOATS, check_pose, check_tensor
from torchelev.observations.patterns import compute_heading
from torchelev.ops.transforms import is_readable
from torchelev.planning.polygons import rasterize
from torchelev.state import MapState

if TYPE_CHECKING:
    from jaxtyping import Bool, Float

MAX_CELL_OFFSET = 2.0**30  # [cells] from the window's corner; farther away, cell numbers may overflow


def place_footprint(
    emap: ElevationMap, footprint: Float[Tensor, "V 2"], poses: Float[Tensor, "B T 3"] | Float[Tensor, "B T 4 4"]
) -> Float[Tensor, "B T V 2"]:
    """Place a footprint at poses, as polygons for `check_footprint`.

    With one pose for each robot, `[:, 0]` of the result is the `standing` argument of `plan` and the checks.

    Args:
        emap: the maps.
        footprint: vertices of a polygon [m], base frame.
        poses: x, y [m] and yaw [rad], map frame; or T_map_base, of which the position and the heading are used.

    Returns:
        The vertices [m], map frame, float64.

    Raises:
        ValueError, TypeError: for a wrong shape, dtype or device.
    """
    return transform_polygon(check_polygon(emap, footprint), check_poses(emap, poses))


def mark_standing_cells(
    emap: ElevationMap, standing: Float[Tensor, "B V 2"], state: MapState | None = None
) -> Bool[Tensor, "B H W"]:
    """Mark the cells under the footprints on which the robots stand now, as `polygons.rasterize` does.

    Footprints with NaN or inf, or larger than the window, mark no cells.

    Raises:
        ValueError, TypeError: for a wrong shape, dtype or device.
    """
    value, grid = check_tensor("standing", standing, emap.device, FLOATS), emap.cfg.grid
    shape, hint = tuple(value.shape), "give each robot's present footprint, map frame (place_footprint)"
    fits = len(shape) == 3 and shape[0] == emap.num_envs and shape[1] >= 3 and shape[2] == 2
    require(fits, "standing", f"expected ({emap.num_envs}, V, 2) with V >= 3", shape, hint)
    size = max(grid.height, grid.width) + 1
    uv = value.detach().double() / grid.resolution - (emap.state if state is None else state).corner[:, None]
    is_usable = (uv.abs() < MAX_CELL_OFFSET).flatten(1).all(1) & ((uv.amax(1) - uv.amin(1)).amax(-1) <= size - 1)
    first, inside = rasterize(torch.where(is_usable[:, None, None], uv, 0.0)[:, None], size)
    rows, in_rows = _patch_lines(first[:, 0, 0], grid.height, size)
    columns, in_columns = _patch_lines(first[:, 0, 1], grid.width, size)
    cell = (rows[:, :, None] * size + columns[:, None, :]).flatten(1)
    marked = inside.flatten(1).gather(1, cell).view(-1, grid.height, grid.width)
    return marked & in_rows[:, :, None] & in_columns[:, None, :] & is_usable[:, None, None]


def _patch_lines(first: Tensor, num_lines: int, size: int) -> tuple[Tensor, Tensor]:
    """Return the patch's row or column for each one of the map, and whether the patch covers it."""
    line = torch.arange(num_lines, device=first.device) - first[:, None]
    return line.clamp(0, size - 1), (line >= 0) & (line < size)


def check_poses(emap: ElevationMap, poses: object) -> Float[Tensor, "B T 3"]:
    """Check poses and return them as x, y [m] and yaw [rad] in float64."""
    value = check_tensor("poses", poses, emap.device, FLOATS)
    shape = tuple(value.shape)
    fits = shape[:1] == (emap.num_envs,) and len(shape) > 1 and shape[1] >= 1 and shape[2:] in ((3,), (4, 4))
    rule = f"expected ({emap.num_envs}, T, 3) or ({emap.num_envs}, T, 4, 4) with T >= 1"
    require(fits, "poses", rule, shape, "give x, y and yaw, or 4 x 4 matrices")
    if value.ndim == 3:
        return value.detach().double()
    T_map_base = check_pose("poses", value, shape, emap.device, emap.check_values).detach().double()
    x, y = compute_heading(T_map_base.flatten(0, 1)).unbind(-1)
    return torch.cat([T_map_base[..., :2, 3], torch.atan2(y, x).view(*shape[:2], 1)], -1)


def check_polygon(emap: ElevationMap, footprint: object) -> Float[Tensor, "V 2"]:
    """Check a footprint in the base frame and return it in float64."""
    value = check_tensor("footprint", footprint, emap.device, FLOATS)
    fits = value.ndim == 2 and value.shape[0] >= 3 and value.shape[1] == 2
    require(fits, "footprint", "expected (V, 2) with V >= 3", tuple(value.shape), "give its vertices, base frame")
    if is_readable(value, emap.check_values):
        is_finite = bool(torch.isfinite(value).all())
        require(is_finite, "footprint", "must be finite", "NaN or inf", "leave those vertices out")
    return value.detach().double()


def transform_polygon(footprint: Float[Tensor, "V 2"], poses: Float[Tensor, "B M 3"]) -> Float[Tensor, "B M V 2"]:
    """Transform a footprint from the base frame to the map frame at each pose x, y, yaw."""
    position, yaw = poses[..., None, :2], poses[..., 2:]
    forward = torch.stack([yaw.cos(), yaw.sin()], -1)
    left = torch.stack([-yaw.sin(), yaw.cos()], -1)
    return position + footprint[:, :1] * forward + footprint[:, 1:] * left
