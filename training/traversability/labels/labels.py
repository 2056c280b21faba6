"""Labels from the robot's physics: where a legged robot can stand on the true terrain, at which headings.

The body is centred over a place, its feet at the corners of a rectangle, each free to take another place within its
reach. Five criteria decide, each a function: support area, slope and roughness of the ground under a foot
(`footholds`), and slope, step and clearance of the stance as a whole (`stances`). A robot
stands if some choice of footholds passes all.

A label says that the robot stands there, not that it gets there: it may stand on an island, or on the floor of a pit.
That is for planners, who see that all around it is unsafe. Nor does a label see the legs between body and feet.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import TYPE_CHECKING

import torch
from torch import Tensor

from torchelev.errors import require, require_count
from torchelev.robot import RobotConfig
from torchelev.sim import HeightField
from training.traversability.labels.stances import STANDS, ground_around, stances

if TYPE_CHECKING:
    from jaxtyping import Bool, Float, Int

CHUNK = 2**14  # stances at once, so that they stay in the processor's cache


def stand(
    field: HeightField,
    tile_ids: Int[Tensor, B],
    xy: Float[Tensor, "B M 2"],
    robots: Sequence[RobotConfig],
    headings: int = 8,
) -> Bool[Tensor, "B M headings"]:
    """Tell whether robots stand with their body centred over places, at headings k * pi / headings.

    Half a turn later the feet have the same places. The mean over the headings is a place's label.

    Args:
        field: the true terrain.
        tile_ids: the tile of each of B robots.
        xy: places [m] in the tile's frame; beyond the rim the rim's height goes on.
        robots: B of them.
        headings: how many.

    Raises ValueError for shapes or numbers that do not fit, tiles that there are not and places that are not finite.
    """
    verdict = verdicts(field, tile_ids, xy, robots, headings)
    return verdict == STANDS


def verdicts(
    field: HeightField,
    tile_ids: Int[Tensor, B],
    xy: Float[Tensor, "B M 2"],
    robots: Sequence[RobotConfig],
    headings: int = 8,
) -> Int[Tensor, "B M headings"]:
    """Return what stops robots, as numbers in VERDICTS; arguments as `stand`'s."""
    _check(field, tile_ids, xy, robots, headings)
    result = torch.zeros(*xy.shape[:2], headings, dtype=torch.int64, device=field.device)
    theta = torch.arange(headings, device=field.device) * (math.pi / headings)
    each = max(1, CHUNK // headings)
    for b, tile in enumerate(tile_ids.tolist() if xy.shape[1] else []):
        places = xy[b].to(field.padded)
        ground = ground_around(field, tile, places, robots[b])
        for m in range(0, len(places), each):
            here = places[m : m + each].repeat_interleave(headings, 0)
            found = stances(ground, here, theta.repeat(len(here) // headings), robots[b])
            result[b, m : m + each] = found.verdict.view(-1, headings)
    return result


def _check(field: HeightField, tile_ids: Tensor, xy: Tensor, robots: Sequence[RobotConfig], headings: int) -> None:
    fits = tile_ids.ndim == 1 and xy.ndim == 3 and xy.shape[::2] == (len(tile_ids), 2) and len(robots) == len(tile_ids)
    actual = f"{tuple(tile_ids.shape)}, {tuple(xy.shape)} and {len(robots)}"
    rule = "must be (B,), (B, M, 2) and B robots"
    require(fits, "tile_ids, xy, robots", rule, actual, "give each robot one tile and M places")
    there = bool(((tile_ids >= 0) & (tile_ids < field.num_tiles)).all())
    require(there, "tile_ids", f"must be from 0 to {field.num_tiles - 1}", tile_ids.tolist(), "name tiles of the field")
    require(bool(xy.isfinite().all()), "xy", "must be finite", "NaN or inf", "leave such places out")
    require_count("headings", headings, "give 8")
