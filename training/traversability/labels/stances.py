"""Stances: a robot's body over a place at a heading, its feet on footholds, and whether it can stand there.

Three criteria decide, besides those of `footholds` on the ground under each foot:

- slope of the plane through the feet,
- step between neighboring feet,
- clearance between the ground and the body.
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
    find_footholds,
    highest_within,
    lattice_around,
    read,
)

if TYPE_CHECKING:
    from jaxtyping import Bool, Float, Int

VERDICTS = ("foothold", "slope", "step", "clearance", "stands")  # the failed criterion, in the order of the checks
STANDS = len(VERDICTS) - 1
CORNERS = ((1, 1), (1, -1), (-1, -1), (-1, 1))  # front left and right, hind right and left
# Which feet take their second foothold; choices with few of them come first.
_CHOICES = sorted(itertools.product((0, 1), repeat=4), key=sum)
_LINE = 0.04  # [m] largest distance between points on the line from foot to foot
_STEP_POINTS = 3  # length of a step on this line
_BODY = 0.08  # [m] approximate distance between points under the body


class Ground(NamedTuple):
    """The ground that stances on one tile are checked against, on a lattice of N nodes."""

    lattice: Lattice
    feet: Footholds
    line: Float[Tensor, "N"]  #: [m] highest ground around a point on the line from foot to foot
    body: Float[Tensor, "N"]  #: [m] highest ground around a point under the body


class Stances(NamedTuple):
    """The outcome for N robots: the latest criterion that a choice of footholds reached, and the choice tried last."""

    verdict: Int[Tensor, "N"]  #: index of VERDICTS
    feet: Float[Tensor, "N 4 3"]  #: [m] tile frame, the footholds; valid where the verdict is "stands"


class StancePlane(NamedTuple):
    """The planes through the feet of N robots."""

    middle: Float[Tensor, "3 N"]  #: [m] mean of the feet
    gradient: Float[Tensor, "2 N"]


def ground_around(field: HeightField, tile: int, xy: Float[Tensor, "M 2"], robot: RobotConfig) -> Ground:
    """Compute the ground around places xy [m] that stances are checked against."""
    lattice = lattice_around(xy, math.hypot(robot.length, robot.width) / 2 + robot.foot_reach + 2 * _BODY)
    tile_ids = torch.tensor([tile], device=field.device)
    heights = field.height(tile_ids, lattice.places(field.device).view(1, -1, 2)).view(lattice.shape)
    half = math.hypot(*(side / n for side, n in zip((robot.length, robot.width), _body_points(robot), strict=True))) / 2
    line, body = (highest_within(heights, math.ceil(d / SPACING - 1e-6)).flatten() for d in (_LINE / 2, half))
    return Ground(lattice, find_footholds(field, tile, lattice, robot), line, body)


def corners(xy: Float[Tensor, "N 2"], theta: Float[Tensor, "N"], robot: RobotConfig) -> Float[Tensor, "N 4 2"]:
    """Return the nominal places of the feet [m], in the order of CORNERS."""
    points = xy.new_tensor(CORNERS) * xy.new_tensor([robot.length / 2, robot.width / 2])
    return _to_tile(xy, theta, points).permute(2, 1, 0)


def _to_tile(xy: Tensor, theta: Tensor, points: Tensor) -> Tensor:
    """Transform points (P, 2) from the body's frame to the tile's, for each of N robots: (2, P, N)."""
    (x, y), cos, sin = points.t()[..., None], theta.cos(), theta.sin()
    return torch.stack([x * cos - y * sin + xy[:, 0], x * sin + y * cos + xy[:, 1]])


def find_stances(ground: Ground, xy: Float[Tensor, "N 2"], theta: Float[Tensor, "N"], robot: RobotConfig) -> Stances:
    """Try the choices of footholds at places xy [m] and headings theta [rad] until one meets all criteria."""
    nominal = corners(xy, theta, robot)
    node = ground.lattice.node(*nominal.unbind(-1))
    soles, levels = ground.feet.sole[node], ground.feet.levels[node]
    verdict = torch.zeros(len(xy), dtype=torch.int64, device=xy.device)
    feet = torch.cat([nominal, torch.zeros_like(nominal[..., :1])], -1)
    for choice in _CHOICES:
        has_choice = (levels > torch.tensor(choice, device=xy.device)).all(1)
        n = ((verdict < STANDS) & has_choice).nonzero()[:, 0]
        tried = soles[n][:, range(4), choice]
        verdict[n] = torch.maximum(verdict[n], _check_stances(ground, tried, xy[n], theta[n], robot))
        feet[n] = tried[..., :3]
    return Stances(verdict, feet)


def _check_stances(ground: Ground, soles: Tensor, xy: Tensor, theta: Tensor, robot: RobotConfig) -> Tensor:
    """Return the criterion that stances on soles (N, 4, 5) fail, as indices of VERDICTS from 1 on."""
    verdict = torch.ones(len(soles), dtype=torch.int64, device=soles.device)
    plane = plane_through(soles[..., :3])
    n = is_gentle(plane, robot).nonzero()[:, 0]  # the stances that met all criteria so far
    verdict[n] += 1
    n = n[_has_low_steps(ground, soles[n], robot)]
    verdict[n] += 1
    plane = StancePlane(plane.middle[:, n], plane.gradient[:, n])
    n = n[_is_clear(ground, plane, xy[n], theta[n], robot)]
    verdict[n] += 1
    return verdict


def plane_through(feet: Float[Tensor, "N 4 3"]) -> StancePlane:
    """Fit the least-squares plane through four feet."""
    middle = feet.mean(1)
    x, y, z = (feet - middle[:, None]).unbind(-1)
    xx, xy, yy, xz, yz = ((a * b).sum(1) for a, b in ((x, x), (x, y), (y, y), (x, z), (y, z)))
    det = (xx * yy - xy * xy).clamp(min=1e-9)  # 0 if the feet are in line
    return StancePlane(middle.t(), torch.stack([(yy * xz - xy * yz) / det, (xx * yz - xy * xz) / det]))


def is_gentle(plane: StancePlane, robot: RobotConfig) -> Bool[Tensor, "N"]:
    """Return which bodies are not too steep: atan |gradient of the plane through the feet| <= max_slope."""
    return plane.gradient.square().sum(0) <= math.tan(robot.max_slope) ** 2


def _has_low_steps(ground: Ground, soles: Float[Tensor, "N 4 5"], robot: RobotConfig) -> Bool[Tensor, "N"]:
    """Return which stances have no step above step_height between neighboring feet.

    Let h_0 to h_K be the heights along the line from the lower foot to the higher one and m_k = max(h_0, ... h_k). The
    step is max_k (m_k+3 - m_k), the rise within about 10 cm, minus the rise by the slope under the two feet. Each riser
    of a stair thus counts by itself, and so does a bar between the feet, but a hole is stepped over.
    """
    low = torch.ones(len(soles), dtype=torch.bool, device=soles.device)
    for pair, side in (((0, 1), robot.width), ((3, 2), robot.width), ((0, 3), robot.length), ((1, 2), robot.length)):
        points = max(_STEP_POINTS, math.ceil((side + 2 * robot.foot_reach) / _LINE))
        low &= _highest_step(ground, soles[:, pair[0]].t(), soles[:, pair[1]].t(), points) <= robot.step_height
    return low


def _highest_step(ground: Ground, a: Float[Tensor, "5 N"], b: Float[Tensor, "5 N"], points: int) -> Float[Tensor, "N"]:
    """Return the highest step [m] on the line from the lower to the higher of two soles."""
    swap = a[2] > b[2]
    (x, y, low, *_), (end_x, end_y, high, *_) = torch.where(swap, b, a), torch.where(swap, a, b)
    dx, dy = (end_x - x) / points, (end_y - y) / points
    k = torch.arange(1, points, device=a.device)[:, None]
    heights = [low, *read(ground.line, ground.lattice.node(x + k * dx, y + k * dy)), high]
    highest = list(itertools.accumulate(heights, torch.maximum))
    rises = [later - before for before, later in zip(highest, highest[_STEP_POINTS:], strict=False)]
    gx, gy = (a[3:] + b[3:]) / 2
    return torch.stack(rises).amax(0) - _STEP_POINTS * (gx * dx + gy * dy).clamp(min=0)


def _is_clear(
    ground: Ground, plane: StancePlane, xy: Float[Tensor, "N 2"], theta: Float[Tensor, "N"], robot: RobotConfig
) -> Bool[Tensor, "N"]:
    """Return which bodies are clear of the ground: max over the body's rectangle of z - plane <= clearance.

    The rectangle is sampled at points about 8 cm apart, each with the highest ground around it, which makes it up to
    3 cm too wide.
    """
    n, m = _body_points(robot)
    along, across = (((torch.arange(k, device=xy.device) + 0.5) / k - 0.5) * side
                     for k, side in ((n, robot.length), (m, robot.width)))  # fmt: skip
    points = torch.cartesian_prod(along, across)
    (mx, my, mz), (gx, gy) = plane
    x, y = _to_tile(xy, theta, points)
    z = read(ground.body, ground.lattice.node(x, y))
    return (z - gx * x - gy * y).amax(0) - (mz - gx * mx - gy * my) <= robot.clearance


def _body_points(robot: RobotConfig) -> tuple[int, int]:
    """Return the number of points along and across the body."""
    return max(1, round(robot.length / _BODY)), max(1, round(robot.width / _BODY))
