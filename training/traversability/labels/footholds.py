"""Where feet can stand: the ground under a robot's foot on a lattice of places, and the best places within its reach.

A foot is a disc. Three criteria decide whether the ground carries it, each on the disc's 13 points:

- support area: enough of the disc lies near its highest point; the rest hangs over a drop,
- slope: the plane of the ground that carries is no steeper than the body's limit,
- roughness: the ground that carries keeps near that plane.

A foot takes the nearest place that carries. Where ground lies on two levels within its reach, as at an edge, it may
take the nearest place on either.
"""

from __future__ import annotations

import functools
import math
from typing import TYPE_CHECKING, NamedTuple

import torch
import torch.nn.functional as F
from torch import Tensor

from torchelev.errors import require
from torchelev.ops.windows import shifted
from torchelev.robot import RobotConfig
from torchelev.sim import HeightField

if TYPE_CHECKING:
    from jaxtyping import Bool, Float, Int

SPACING = 0.02  # [m] of the lattice: how finely a foot chooses its place
SUPPORT = 0.75  # share of the foot's area that must carry
ROUGHNESS = 1 / 6  # [foot radii] standard deviation of the ground that carries
MOST_NODES = 2**24


def disc(radius: float) -> Float[Tensor, "13 2"]:
    """Return points [m] that share a disc evenly; a quarter turn or a mirror maps them onto themselves."""
    points = [(i, j) for i in range(-2, 3) for j in range(-2, 3) if i * i + j * j <= 4]
    return torch.tensor(points, dtype=torch.float32) * (radius / 2)


class Lattice(NamedTuple):
    """The places (i, j) * SPACING of a rectangle in the tile's frame."""

    first: tuple[int, int]  # (i, j) of node [0, 0]
    shape: tuple[int, int]

    def widened(self, nodes: int) -> Lattice:
        """Return the lattice with more nodes on all sides."""
        (i, j), (H, W) = self
        return Lattice((i - nodes, j - nodes), (H + 2 * nodes, W + 2 * nodes))

    def places(self, device: torch.device) -> Float[Tensor, "H W 2"]:
        """Return the nodes' places [m]."""
        lines = [torch.arange(k, k + n, device=device) * SPACING for k, n in zip(*self, strict=True)]
        return torch.stack(torch.meshgrid(*lines, indexing="ij"), -1)

    def node(self, x: Float[Tensor, "*N"], y: Float[Tensor, "*N"]) -> Int[Tensor, "*N"]:
        """Return the number of the node nearest to places [m] on the lattice."""
        (i, j), (_, W) = self
        # In floats, which count up to MOST_NODES exactly: integers take several times as long.
        return torch.add((y / SPACING).round_(), (x / SPACING).round_(), alpha=W).sub_(i * W + j).int()


def read(values: Float[Tensor, N], node: Int[Tensor, "*M"]) -> Float[Tensor, "*M"]:
    """Return values of nodes."""
    return values.index_select(0, node.flatten()).view(node.shape)


def lattice_around(xy: Float[Tensor, "M 2"], margin: float) -> Lattice:
    """Return the lattice of all places within `margin` [m] of some place."""
    low, high = ((end / SPACING).tolist() for end in (xy.amin(0) - margin, xy.amax(0) + margin))
    first = [math.floor(k) for k in low]
    H, W = (math.ceil(k) + 1 - a for k, a in zip(high, first, strict=True))
    hint = "rate smaller regions, one after the other"
    require(H * W <= MOST_NODES, "xy", "must lie within some 80 x 80 m", f"{H * SPACING:g} x {W * SPACING:g} m", hint)
    return Lattice((first[0], first[1]), (H, W))


class Sole(NamedTuple):
    """The ground under a foot at each of N places, as far as it carries."""

    support: Float[Tensor, N]  # share of the foot's area
    gradient: Float[Tensor, "2 N"]  # of the plane
    roughness: Float[Tensor, N]  # [m]
    height: Float[Tensor, N]  # [m] of the plane below the foot's middle


def sole(z: Float[Tensor, "13 N"], points: Float[Tensor, "13 2"], tolerance: float) -> Sole:
    """Fit the least-squares plane of the ground that carries: all at most `tolerance` [m] below the highest point.

    support = number of those / 13; roughness = their standard deviation around the plane.
    """
    highest = z.amax(0)
    depth = highest - z
    carries = (depth <= tolerance).to(z.dtype)
    x, y = points.t()
    one = torch.ones_like(x)
    n, mx, my, xx, xy, yy = torch.stack([one, x, y, x * x, x * y, y * y]) @ carries
    md, xd, yd = torch.stack([one, x, y]) @ (carries * depth)
    dd = (carries * depth.square()).sum(0)
    mx, my, md = mx / n, my / n, md / n
    cxx, cxy, cyy = xx / n - mx * mx, xy / n - mx * my, yy / n - my * my
    cxd, cyd = xd / n - mx * md, yd / n - my * md
    det = (cxx * cyy - cxy * cxy).clamp(min=1e-3 * points.square().amax() ** 2)  # below it too few carry anyway
    gx, gy = (cyy * cxd - cxy * cyd) / det, (cxx * cyd - cxy * cxd) / det
    residual = dd / n - md * md - gx * cxd - gy * cyd
    height = highest - (md - gx * mx - gy * my)
    return Sole(n / len(z), -torch.stack([gx, gy]), residual.clamp(min=0).sqrt(), height)


def enough_support(ground: Sole) -> Bool[Tensor, N]:
    """Tell where enough of the foot stands on something: support >= 0.75.

    What lies deeper below the highest point than a foot spans on the steepest ground, 2 r tan(max_slope), carries
    nothing: a straight edge may come as near as half a foot's radius to its middle.
    """
    return ground.support >= SUPPORT


def gentle_sole(ground: Sole, robot: RobotConfig) -> Bool[Tensor, N]:
    """Tell where a foot does not slide: |gradient| <= tan(max_slope), so that this limit is one of friction too."""
    return ground.gradient.square().sum(0) <= math.tan(robot.max_slope) ** 2


def smooth_sole(ground: Sole, robot: RobotConfig) -> Bool[Tensor, N]:
    """Tell where a foot does not rest on bumps: roughness <= r / 6, what a ball of radius r evens out.

    Over its disc the ball's own underside has a standard deviation of 0.24 r around its mean.
    """
    return ground.roughness <= ROUGHNESS * robot.foot_radius


def carrying(z: Float[Tensor, "13 N"], robot: RobotConfig) -> tuple[Bool[Tensor, N], Sole]:
    """Return where the ground under feet carries them, and what it is like."""
    tolerance = 2 * robot.foot_radius * math.tan(robot.max_slope) + 1e-6
    ground = sole(z, disc(robot.foot_radius).to(z), tolerance)
    return enough_support(ground) & gentle_sole(ground, robot) & smooth_sole(ground, robot), ground


class Footholds(NamedTuple):
    """The two soles that a foot may take instead of each of N nominal ones: the nearest, then the other level's."""

    sole: Float[Tensor, "N 2 5"]  # x, y, z [m] in the tile's frame, dz/dx, dz/dy
    levels: Int[Tensor, N]  # how many of the two there are: 0, 1 or 2


def footholds(field: HeightField, tile: int, lattice: Lattice, robot: RobotConfig) -> Footholds:
    """Find the footholds within reach of each node of a lattice on a tile."""
    reach = int(robot.foot_reach / SPACING + 1e-6)
    wide = lattice.widened(reach)
    places = wide.places(field.device)
    points = places + disc(robot.foot_radius).to(field.device)[:, None, None]
    z = field.height(torch.tensor([tile], device=field.device), points.view(1, -1, 2)).view(len(points), -1)
    good, ground = carrying(z, robot)
    table = torch.cat([places.view(-1, 2), ground.height[:, None], ground.gradient.t()], 1)
    height = torch.where(good, ground.height, -torch.inf).view(wide.shape)
    chosen, levels = within_reach(height, reach, 2 * robot.foot_reach * math.tan(robot.max_slope))
    return Footholds(table[chosen], levels)


def within_reach(height: Float[Tensor, "H W"], reach: int, span: float) -> tuple[Int[Tensor, "N 2"], Int[Tensor, N]]:
    """Return the nodes that feet may take, and how many, for each node that has a rim of `reach` nodes.

    `height` [m] is -inf where ground does not carry. A level is all good ground within reach at most `span` [m] below
    the highest of it, or above the lowest; on ground that a robot can climb both are one.
    """
    steps = range(-reach, reach + 1)
    around = [(i, j) for i in steps for j in steps if i * i + j * j <= reach * reach]
    lower = torch.where(height > -torch.inf, height, torch.inf)
    highest = functools.reduce(torch.maximum, (shifted(height, reach, i, j) for i, j in around)).flatten()
    lowest = functools.reduce(torch.minimum, (shifted(lower, reach, i, j) for i, j in around)).flatten()
    middle = shifted(torch.arange(height.numel(), device=height.device).view(height.shape), reach).flatten()
    # Most places carry, and all around them is on one level: they need no search.
    levels = ((height.flatten()[middle] > -torch.inf) & (highest - lowest <= span)).long()
    chosen = middle[:, None].repeat(1, 2)
    ask = ((highest > -torch.inf) & (levels == 0)).nonzero()[:, 0]
    upper, cost_up = _nearest(height, middle[ask], (highest - span)[ask], span, around)
    lower, cost_low = _nearest(height, middle[ask], lowest[ask], span, around)
    pair = torch.stack([upper, lower], 1)
    chosen[ask] = torch.where((cost_low < cost_up)[:, None], pair.flip(1), pair)
    levels[ask] = 1 + (upper != lower).long()
    return chosen, levels


def _nearest(
    height: Tensor, node: Tensor, floor: Tensor, span: float, around: list[tuple[int, int]]
) -> tuple[Tensor, Tensor]:
    """Return the nearest of the nodes around each node that is at most `span` above a floor, and its distance^2."""
    height, W = height.flatten(), height.shape[1]
    cost, best = torch.full_like(floor, torch.inf), node
    for i, j in around:
        there = node + (i * W + j)
        share = (height[there] - floor) / span
        found = (i * i + j * j) + (1 - share) / 2  # the higher of two as near
        better = ((share - 0.5).abs() < 0.501) & (found < cost)  # but for rounding, share is from 0 to 1
        cost, best = torch.where(better, found, cost), torch.where(better, there, best)
    return best, cost


def highest_within(heights: Float[Tensor, "H W"], nodes: int) -> Float[Tensor, "H W"]:
    """Return the highest of the (2 nodes + 1)^2 heights around each node, of those that there are."""
    return F.max_pool2d(heights[None, None], 2 * nodes + 1, 1, padding=nodes)[0, 0]
