"""The labels: where a legged robot can stand on the true terrain, and at which headings.

The body is centered over a place, with its feet at the corners of a rectangle; each foot may take another place within
its reach. Six criteria decide, each a function: support area, slope and roughness of the ground under a foot
(`footholds`), and slope, step and clearance of the whole stance (`stances`). A robot can stand if some choice of
footholds meets all of them.

A label does not say that the robot can get there: it may be on an island or on the floor of a pit, which a planner sees
from the unsafe ground around it. Nor does a label consider the legs between body and feet.
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
from training.traversability.labels.stances import STANDS, find_stances, ground_around

if TYPE_CHECKING:
    from jaxtyping import Bool, Float, Int

_CHUNK = 2**14  # stances at a time, so that they stay in the processor's cache


def can_stand(
    field: HeightField,
    tile_ids: Int[Tensor, "B"],
    xy: Float[Tensor, "B M 2"],
    robots: Sequence[RobotConfig],
    headings: int = 8,
) -> Bool[Tensor, "B M headings"]:
    """Return whether robots can stand with their body centered over places, at headings k * pi / headings.

    After half a turn the feet are at the same places, so headings cover half a circle. The mean over the headings is
    the label of a place.

    Args:
        field: the true terrain.
        tile_ids: the tile of each robot (B,).
        xy: places (B, M, 2) [m] in the tile's frame; beyond the rim, the height of the rim continues.
        robots: the B robots.
        headings: number of headings.

    Returns:
        (B, M, headings), bool.

    Raises:
        ValueError: shapes or numbers do not fit, a tile does not exist, or a place is not finite.
    """
    return verdicts(field, tile_ids, xy, robots, headings) == STANDS


def verdicts(
    field: HeightField,
    tile_ids: Int[Tensor, "B"],
    xy: Float[Tensor, "B M 2"],
    robots: Sequence[RobotConfig],
    headings: int = 8,
) -> Int[Tensor, "B M headings"]:
    """Return the criterion that each stance fails, as indices of VERDICTS; arguments as in `can_stand`."""
    _check(field, tile_ids, xy, robots, headings)
    result = torch.zeros(*xy.shape[:2], headings, dtype=torch.int64, device=field.device)
    theta = torch.arange(headings, device=field.device) * (math.pi / headings)
    each = max(1, _CHUNK // headings)
    for b, tile in enumerate(tile_ids.tolist() if xy.shape[1] else []):
        places = xy[b].to(field.padded)
        ground = ground_around(field, tile, places, robots[b])
        for m in range(0, len(places), each):
            here = places[m : m + each].repeat_interleave(headings, 0)
            found = find_stances(ground, here, theta.repeat(len(here) // headings), robots[b])
            result[b, m : m + each] = found.verdict.view(-1, headings)
    return result


def _check(field: HeightField, tile_ids: Tensor, xy: Tensor, robots: Sequence[RobotConfig], headings: int) -> None:
    fits = tile_ids.ndim == 1 and xy.ndim == 3 and xy.shape[::2] == (len(tile_ids), 2) and len(robots) == len(tile_ids)
    actual = f"{tuple(tile_ids.shape)}, {tuple(xy.shape)} and {len(robots)}"
    rule = "must be (B,), (B, M, 2) and B robots"
    require(fits, "tile_ids, xy, robots", rule, actual, "give each robot one tile and M places")
    exist = bool(((tile_ids >= 0) & (tile_ids < field.num_tiles)).all())
    require(exist, "tile_ids", f"must be from 0 to {field.num_tiles - 1}", tile_ids.tolist(), "name tiles of the field")
    require(bool(xy.isfinite().all()), "xy", "must be finite", "NaN or inf", "leave these places out")
    require_count("headings", headings, "give 8")
