"""Where robots stand now: unknown ground under the footprint there is assumed to carry the robot.

A robot's sensors rarely see the ground that it stands on. `plan`, `check_path` and `check_footprint` share one rule:
where the robot stands now, cells whose traversability is unknown are assumed passable, as it stands on them. Known
cells there are judged as everywhere else, and so is all ground that the footprint reaches later.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import torch
from torch import Tensor

from torchelev.checks import FLOATS, check_pose, check_tensor, readable
from torchelev.elevation_map import ElevationMap
from torchelev.errors import require
from torchelev.observations.patterns import heading
from torchelev.planning.polygons import polygon_cells
from torchelev.state import MapState

if TYPE_CHECKING:
    from jaxtyping import Bool, Float

FARTHEST_CELLS = 2.0**30  # from the window; farther, a number of cells may not fit an integer


def place_footprint(
    emap: ElevationMap, footprint: Float[Tensor, "V 2"], poses: Float[Tensor, "B T 3"] | Float[Tensor, "B T 4 4"]
) -> Float[Tensor, "B T V 2"]:
    """Place a footprint at poses, as polygons for `check_footprint`; `[:, 0]` of one pose each is a `standing`.

    Args:
        emap: the maps.
        footprint: a polygon [m], base frame.
        poses: x, y [m], map frame, and yaw [rad]; or T_map_base, of which the heading counts.

    Returns the vertices [m], map frame, float64.

    Raises ValueError or TypeError for inputs that do not fit.
    """
    return at_poses(check_polygon(emap, footprint), as_xy_yaw(emap, poses))


def standing_cells(
    emap: ElevationMap, standing: Float[Tensor, "B V 2"], state: MapState | None = None
) -> Bool[Tensor, "B H W"]:
    """Mark the cells under the footprints on which the robots stand, by the rule of `polygons.polygon_cells`.

    Footprints with NaN or inf, or longer than the window, mark nothing.

    Raises ValueError or TypeError for a wrong shape, dtype or device.
    """
    value, grid = check_tensor("standing", standing, emap.device, FLOATS), emap.cfg.grid
    shape, hint = tuple(value.shape), "give each robot's footprint where it stands, map frame (place_footprint)"
    fits = len(shape) == 3 and shape[0] == emap.num_envs and shape[1] >= 3 and shape[2] == 2
    require(fits, "standing", f"expected ({emap.num_envs}, V, 2) with V >= 3", shape, hint)
    size = max(grid.height, grid.width) + 1
    uv = value.detach().double() / grid.resolution - (emap.state if state is None else state).corner[:, None]
    good = (uv.abs() < FARTHEST_CELLS).flatten(1).all(1) & ((uv.amax(1) - uv.amin(1)).amax(-1) <= size - 1)
    first, inside = polygon_cells(torch.where(good[:, None, None], uv, 0.0)[:, None], size)
    rows, in_rows = _on_patch(first[:, 0, 0], grid.height, size)
    columns, in_columns = _on_patch(first[:, 0, 1], grid.width, size)
    cell = (rows[:, :, None] * size + columns[:, None, :]).flatten(1)
    found = inside.flatten(1).gather(1, cell).view(-1, grid.height, grid.width)
    return found & in_rows[:, :, None] & in_columns[:, None, :] & good[:, None, None]


def _on_patch(first: Tensor, cells: int, size: int) -> tuple[Tensor, Tensor]:
    """Return each of the map's lines as a line of the patch, and whether the patch has it."""
    line = torch.arange(cells, device=first.device) - first[:, None]
    return line.clamp(0, size - 1), (line >= 0) & (line < size)


def as_xy_yaw(emap: ElevationMap, poses: object) -> Float[Tensor, "B T 3"]:
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


def check_polygon(emap: ElevationMap, footprint: object) -> Float[Tensor, "V 2"]:
    """Check a footprint in the base frame and return it in float64."""
    value = check_tensor("footprint", footprint, emap.device, FLOATS)
    fits = value.ndim == 2 and value.shape[0] >= 3 and value.shape[1] == 2
    require(fits, "footprint", "expected (V, 2) with V >= 3", tuple(value.shape), "give its corners, base frame")
    if readable(value, emap.check_values):
        finite = bool(torch.isfinite(value).all())
        require(finite, "footprint", "must be finite", "NaN or inf", "leave those vertices out")
    return value.detach().double()


def at_poses(footprint: Float[Tensor, "V 2"], poses: Float[Tensor, "B M 3"]) -> Float[Tensor, "B M V 2"]:
    """Return the footprint at each pose, map frame."""
    position, yaw = poses[..., None, :2], poses[..., 2:]
    ahead = torch.stack([yaw.cos(), yaw.sin()], -1)
    left = torch.stack([-yaw.sin(), yaw.cos()], -1)
    return position + footprint[:, :1] * ahead + footprint[:, 1:] * left
