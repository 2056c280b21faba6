"""Stances: a robot's body over a place at a heading, its feet on footholds, and whether it stands so.

Three criteria decide, beside those of `footholds` on the ground under each foot:

- slope: of the plane through the feet,
- step: what a foot must overcome between neighbouring feet,
- clearance: of the ground under the body.
"""

from __future__ import annotations

import itertools
import math
from typing import TYPE_CHECKING, NamedTuple

import torch
from torch import Tensor

from torchelev.robot import RobotConfig
from torchelev.sim import HeightField
from training.traversability.labels.footholds import (
    SPACING,
    Footholds,
    Lattice,
    footholds,
    highest_within,
    lattice_around,
    read,
)

if TYPE_CHECKING:
    from jaxtyping import Bool, Float, Int

VERDICTS = ("foothold", "slope", "step", "clearance", "stands")  # what stops a stance, in the order of the checks
STANDS = len(VERDICTS) - 1
CORNERS = ((1, 1), (1, -1), (-1, -1), (-1, 1))  # front left and right, hind right and left
# Which foot takes its second choice: as few as possible first.
CHOICES = sorted(itertools.product((0, 1), repeat=4), key=sum)
LINE = 0.04  # [m] at most between the points of the line from foot to foot
STEP_POINTS = 3  # of them that a step spans
BODY = 0.08  # [m] about, between the points under the body


class Ground(NamedTuple):
    """What stances on one tile are checked against, on a lattice of N nodes."""

    lattice: Lattice
    feet: Footholds
    line: Float[Tensor, N]  # [m] highest ground around a point of a line from foot to foot
    body: Float[Tensor, N]  # [m] highest ground around a point under the body


class Stances(NamedTuple):
    """N stances, of those that a robot tried the one that failed last."""

    verdict: Int[Tensor, N]  # a number in VERDICTS
    feet: Float[Tensor, "N 4 3"]  # [m] tile frame, the footholds; where the verdict is "stands"


class StancePlane(NamedTuple):
    """The planes of N bodies."""

    middle: Float[Tensor, "3 N"]  # [m] mean of the feet
    gradient: Float[Tensor, "2 N"]


def ground_around(field: HeightField, tile: int, xy: Float[Tensor, "M 2"], robot: RobotConfig) -> Ground:
    """Compute what stances at places xy [m] need to know of a tile."""
    lattice = lattice_around(xy, math.hypot(robot.length, robot.width) / 2 + robot.foot_reach + 2 * BODY)
    tile_ids = torch.tensor([tile], device=field.device)
    heights = field.height(tile_ids, lattice.places(field.device).view(1, -1, 2)).view(lattice.shape)
    half = math.hypot(*(side / n for side, n in zip((robot.length, robot.width), _body_points(robot), strict=True))) / 2
    line, body = (highest_within(heights, math.ceil(d / SPACING - 1e-6)).flatten() for d in (LINE / 2, half))
    return Ground(lattice, footholds(field, tile, lattice, robot), line, body)


def corners(xy: Float[Tensor, "N 2"], theta: Float[Tensor, N], robot: RobotConfig) -> Float[Tensor, "N 4 2"]:
    """Return the feet's nominal places [m], in the order of CORNERS."""
    points = xy.new_tensor(CORNERS) * xy.new_tensor([robot.length / 2, robot.width / 2])
    return _turned(xy, theta, points).permute(2, 1, 0)


def _turned(xy: Tensor, theta: Tensor, points: Tensor) -> Tensor:
    """Return points (P, 2) of the body's frame in the tile's: (2, P, N)."""
    (x, y), cos, sin = points.t()[..., None], theta.cos(), theta.sin()
    return torch.stack([x * cos - y * sin + xy[:, 0], x * sin + y * cos + xy[:, 1]])


def stances(ground: Ground, xy: Float[Tensor, "N 2"], theta: Float[Tensor, N], robot: RobotConfig) -> Stances:
    """Let robots try their footholds at places xy [m] and headings theta [rad], until a choice stands."""
    nominal = corners(xy, theta, robot)
    node = ground.lattice.node(*nominal.unbind(-1))
    soles, levels = ground.feet.sole[node], ground.feet.levels[node]
    verdict = torch.zeros(len(xy), dtype=torch.int64, device=xy.device)
    feet = torch.cat([nominal, torch.zeros_like(nominal[..., :1])], -1)
    for choice in CHOICES:
        ask = ((verdict < STANDS) & (levels > torch.tensor(choice, device=xy.device)).all(1)).nonzero()[:, 0]
        tried = soles[ask][:, range(4), choice]
        verdict[ask] = torch.maximum(verdict[ask], _check_stances(ground, tried, xy[ask], theta[ask], robot))
        feet[ask] = tried[..., :3]
    return Stances(verdict, feet)


def _check_stances(ground: Ground, soles: Tensor, xy: Tensor, theta: Tensor, robot: RobotConfig) -> Tensor:
    """Return what stops stances on soles (N, 4, 5): a number in VERDICTS, from 1 on."""
    verdict = torch.ones(len(soles), dtype=torch.int64, device=soles.device)
    plane = plane_through(soles[..., :3])
    left = gentle(plane, robot).nonzero()[:, 0]
    verdict[left] += 1
    left = left[low_steps(ground, soles[left], robot)]
    verdict[left] += 1
    plane = StancePlane(plane.middle[:, left], plane.gradient[:, left])
    left = left[clear(ground, plane, xy[left], theta[left], robot)]
    verdict[left] += 1
    return verdict


def plane_through(feet: Float[Tensor, "N 4 3"]) -> StancePlane:
    """Fit the least-squares plane through four feet."""
    middle = feet.mean(1)
    x, y, z = (feet - middle[:, None]).unbind(-1)
    xx, xy, yy, xz, yz = ((a * b).sum(1) for a, b in ((x, x), (x, y), (y, y), (x, z), (y, z)))
    det = (xx * yy - xy * xy).clamp(min=1e-9)  # of feet in a line it is zero
    return StancePlane(middle.t(), torch.stack([(yy * xz - xy * yz) / det, (xx * yz - xy * xz) / det]))


def gentle(plane: StancePlane, robot: RobotConfig) -> Bool[Tensor, N]:
    """Tell which bodies are not too steep: atan |gradient of the plane through the feet| <= max_slope."""
    return plane.gradient.square().sum(0) <= math.tan(robot.max_slope) ** 2


def low_steps(ground: Ground, soles: Float[Tensor, "N 4 5"], robot: RobotConfig) -> Bool[Tensor, N]:
    """Tell which stances have no step above step_height between neighbouring feet.

    h_0 to h_K is the ground along the line from the lower foot to the higher one, m_k = max(h_0, ... h_k). The step is
    max_k (m_k+3 - m_k), what rises within some 10 cm, less what the slope under the two feet explains. So each riser of
    a stair counts by itself, and a bar that stands between the feet too, but a hole is stepped over.
    """
    low = torch.ones(len(soles), dtype=torch.bool, device=soles.device)
    for pair, side in (((0, 1), robot.width), ((3, 2), robot.width), ((0, 3), robot.length), ((1, 2), robot.length)):
        points = max(STEP_POINTS, math.ceil((side + 2 * robot.foot_reach) / LINE))
        low &= highest_step(ground, soles[:, pair[0]].t(), soles[:, pair[1]].t(), points) <= robot.step_height
    return low


def highest_step(ground: Ground, a: Float[Tensor, "5 N"], b: Float[Tensor, "5 N"], points: int) -> Float[Tensor, N]:
    """Return the highest step [m] on the way from the lower to the higher of two soles."""
    swap = a[2] > b[2]
    (x, y, low, *_), (end_x, end_y, high, *_) = torch.where(swap, b, a), torch.where(swap, a, b)
    dx, dy = (end_x - x) / points, (end_y - y) / points
    k = torch.arange(1, points, device=a.device)[:, None]
    heights = [low, *read(ground.line, ground.lattice.node(x + k * dx, y + k * dy)), high]
    highest = list(itertools.accumulate(heights, torch.maximum))
    rises = [later - before for before, later in zip(highest, highest[STEP_POINTS:], strict=False)]
    gx, gy = (a[3:] + b[3:]) / 2
    return torch.stack(rises).amax(0) - STEP_POINTS * (gx * dx + gy * dy).clamp(min=0)


def clear(
    ground: Ground, plane: StancePlane, xy: Float[Tensor, "N 2"], theta: Float[Tensor, N], robot: RobotConfig
) -> Bool[Tensor, N]:
    """Tell which bodies are clear of the ground: max over the body's rectangle of z - plane <= clearance.

    The rectangle is read at points about 8 cm apart, each for the ground around it, and so up to 3 cm too wide.
    """
    n, m = _body_points(robot)
    along, across = (((torch.arange(k, device=xy.device) + 0.5) / k - 0.5) * side
                     for k, side in ((n, robot.length), (m, robot.width)))  # fmt: skip
    points = torch.cartesian_prod(along, across)
    (mx, my, mz), (gx, gy) = plane
    x, y = _turned(xy, theta, points)
    z = read(ground.body, ground.lattice.node(x, y))
    return (z - gx * x - gy * y).amax(0) - (mz - gx * mx - gy * my) <= robot.clearance


def _body_points(robot: RobotConfig) -> tuple[int, int]:
    """Return how many points there are along and across the body."""
    return max(1, round(robot.length / BODY)), max(1, round(robot.width / BODY))
