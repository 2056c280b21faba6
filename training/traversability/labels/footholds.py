"""Where feet can stand: the ground under a foot at the nodes of a lattice, and the best nodes within a foot's reach.

A foot is a disc. Three criteria decide whether the ground carries it, each evaluated at 13 points of the disc:

- support area: enough of the disc lies near its highest point and does not hang over a drop,
- slope: the plane of the supporting ground is at most as steep as the body's limit,
- roughness: the supporting ground is close to that plane.

A foot takes the nearest foothold. Where there is ground on two levels within its reach, as at an edge, it may take the
nearest foothold on either.
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

SPACING = 0.02  # [m] of the lattice
_MIN_SUPPORT = 0.75  # fraction of the foot's area
_MAX_ROUGHNESS = 1 / 6  # [foot radii] standard deviation of the supporting ground
_MAX_NODES = 2**24


def disc(radius: float) -> Float[Tensor, "13 2"]:
    """Return points [m] that divide a disc evenly and are symmetric under quarter turns and reflections."""
    points = [(i, j) for i in range(-2, 3) for j in range(-2, 3) if i * i + j * j <= 4]
    return torch.tensor(points, dtype=torch.float32) * (radius / 2)


class Lattice(NamedTuple):
    """A rectangle of nodes at the places (i, j) * SPACING in the tile's frame."""

    first: tuple[int, int]  #: (i, j) of node [0, 0]
    shape: tuple[int, int]

    def widen(self, nodes: int) -> Lattice:
        """Return the lattice with `nodes` more nodes on all sides."""
        (i, j), (H, W) = self
        return Lattice((i - nodes, j - nodes), (H + 2 * nodes, W + 2 * nodes))

    def places(self, device: torch.device) -> Float[Tensor, "H W 2"]:
        """Return the places of the nodes [m]."""
        lines = [torch.arange(k, k + n, device=device) * SPACING for k, n in zip(*self, strict=True)]
        return torch.stack(torch.meshgrid(*lines, indexing="ij"), -1)

    def node(self, x: Float[Tensor, "*N"], y: Float[Tensor, "*N"]) -> Int[Tensor, "*N"]:
        """Return the number of the node nearest to each place [m]."""
        (i, j), (_, W) = self
        # In floats, which are exact up to _MAX_NODES: integers take several times as long.
        return torch.add((y / SPACING).round_(), (x / SPACING).round_(), alpha=W).sub_(i * W + j).int()


def read(values: Float[Tensor, "N"], node: Int[Tensor, "*M"]) -> Float[Tensor, "*M"]:
    """Return the values at nodes."""
    return values.index_select(0, node.flatten()).view(node.shape)


def lattice_around(xy: Float[Tensor, "M 2"], margin: float) -> Lattice:
    """Return the lattice that covers all places within `margin` [m] of the places xy [m]."""
    low, high = ((end / SPACING).tolist() for end in (xy.amin(0) - margin, xy.amax(0) + margin))
    first = [math.floor(k) for k in low]
    H, W = (math.ceil(k) + 1 - a for k, a in zip(high, first, strict=True))
    hint = "rate smaller regions, one after the other"
    require(H * W <= _MAX_NODES, "xy", "must lie within some 80 x 80 m", f"{H * SPACING:g} x {W * SPACING:g} m", hint)
    return Lattice((first[0], first[1]), (H, W))


class Sole(NamedTuple):
    """The supporting ground under a foot at each of N places."""

    support: Float[Tensor, "N"]  #: fraction of the foot's area
    gradient: Float[Tensor, "2 N"]  #: of the fitted plane
    roughness: Float[Tensor, "N"]  #: [m] standard deviation around the plane
    height: Float[Tensor, "N"]  #: [m] of the plane at the foot's center


def fit_sole(z: Float[Tensor, "13 N"], points: Float[Tensor, "13 2"], tolerance: float) -> Sole:
    """Fit a least-squares plane to the supporting ground: the points at most `tolerance` [m] below the highest one.

    support = number of these points / 13; roughness = their standard deviation around the plane.
    """
    highest = z.amax(0)
    depth = highest - z
    supports = (depth <= tolerance).to(z.dtype)
    x, y = points.t()
    one = torch.ones_like(x)
    n, mx, my, xx, xy, yy = torch.stack([one, x, y, x * x, x * y, y * y]) @ supports
    md, xd, yd = torch.stack([one, x, y]) @ (supports * depth)
    dd = (supports * depth.square()).sum(0)
    mx, my, md = mx / n, my / n, md / n
    cxx, cxy, cyy = xx / n - mx * mx, xy / n - mx * my, yy / n - my * my
    cxd, cyd = xd / n - mx * md, yd / n - my * md
    det = (cxx * cyy - cxy * cxy).clamp(
        min=1e-3 * points.square().amax() ** 2
    )  # smaller only if too few points support
    gx, gy = (cyy * cxd - cxy * cyd) / det, (cxx * cyd - cxy * cxd) / det
    residual = dd / n - md * md - gx * cxd - gy * cyd
    height = highest - (md - gx * mx - gy * my)
    return Sole(n / len(z), -torch.stack([gx, gy]), residual.clamp(min=0).sqrt(), height)


def _has_support(sole: Sole) -> Bool[Tensor, "N"]:
    """Return where enough of the foot is supported: support >= 0.75.

    Points more than 2 r tan(max_slope) below the highest one, what a foot of radius r spans on the steepest ground, do
    not support it. A straight edge may thus be as close as r / 2 to the foot's center.
    """
    return sole.support >= _MIN_SUPPORT


def _is_gentle(sole: Sole, robot: RobotConfig) -> Bool[Tensor, "N"]:
    """Return where a foot does not slide: |gradient| <= tan(max_slope), which thus limits friction too."""
    return sole.gradient.square().sum(0) <= math.tan(robot.max_slope) ** 2


def _is_smooth(sole: Sole, robot: RobotConfig) -> Bool[Tensor, "N"]:
    """Return where a foot does not rest on bumps: roughness <= r / 6, which a ball of radius r evens out.

    For comparison, the underside of the ball has a standard deviation of 0.24 r around its mean.
    """
    return sole.roughness <= _MAX_ROUGHNESS * robot.foot_radius


def check_soles(z: Float[Tensor, "13 N"], robot: RobotConfig) -> tuple[Bool[Tensor, "N"], Sole]:
    """Return at which places the ground, of heights z [m] under the foot, carries it, and the fitted soles."""
    tolerance = 2 * robot.foot_radius * math.tan(robot.max_slope) + 1e-6
    sole = fit_sole(z, disc(robot.foot_radius).to(z), tolerance)
    return _has_support(sole) & _is_gentle(sole, robot) & _is_smooth(sole, robot), sole


class Footholds(NamedTuple):
    """The two footholds that a foot may take at each of N nominal places: the nearest, and that on the other level."""

    sole: Float[Tensor, "N 2 5"]  #: x, y, z [m] in the tile's frame, dz/dx, dz/dy
    levels: Int[Tensor, "N"]  #: number of footholds: 0, 1 or 2


def find_footholds(field: HeightField, tile: int, lattice: Lattice, robot: RobotConfig) -> Footholds:
    """Find the footholds within a foot's reach of each node of a lattice on a tile."""
    reach = int(robot.foot_reach / SPACING + 1e-6)
    wide = lattice.widen(reach)
    places = wide.places(field.device)
    points = places + disc(robot.foot_radius).to(field.device)[:, None, None]
    z = field.height(torch.tensor([tile], device=field.device), points.view(1, -1, 2)).view(len(points), -1)
    carries, sole = check_soles(z, robot)
    table = torch.cat([places.view(-1, 2), sole.height[:, None], sole.gradient.t()], 1)
    height = torch.where(carries, sole.height, -torch.inf).view(wide.shape)
    chosen, levels = choose_nodes(height, reach, 2 * robot.foot_reach * math.tan(robot.max_slope))
    return Footholds(table[chosen], levels)


def choose_nodes(height: Float[Tensor, "H W"], reach: int, span: float) -> tuple[Int[Tensor, "N 2"], Int[Tensor, "N"]]:
    """Return the nodes that a foot may take, and their number, for each node at least `reach` nodes from the rim.

    `height` [m] is -inf where the ground does not carry. The upper level is the carrying ground within reach at most
    `span` [m] below its highest node, the lower one that at most `span` above its lowest. On ground that a robot can
    climb, both are the same.
    """
    steps = range(-reach, reach + 1)
    around = [(i, j) for i in steps for j in steps if i * i + j * j <= reach * reach]
    lower = torch.where(height > -torch.inf, height, torch.inf)
    highest = functools.reduce(torch.maximum, (shifted(height, reach, i, j) for i, j in around)).flatten()
    lowest = functools.reduce(torch.minimum, (shifted(lower, reach, i, j) for i, j in around)).flatten()
    middle = shifted(torch.arange(height.numel(), device=height.device).view(height.shape), reach).flatten()
    # Most nodes carry and have a single level around them; they need no search.
    levels = ((height.flatten()[middle] > -torch.inf) & (highest - lowest <= span)).long()
    chosen = middle[:, None].repeat(1, 2)
    searched = ((highest > -torch.inf) & (levels == 0)).nonzero()[:, 0]
    upper, cost_up = _nearest(height, middle[searched], (highest - span)[searched], span, around)
    lower, cost_low = _nearest(height, middle[searched], lowest[searched], span, around)
    pair = torch.stack([upper, lower], 1)
    chosen[searched] = torch.where((cost_low < cost_up)[:, None], pair.flip(1), pair)
    levels[searched] = 1 + (upper != lower).long()
    return chosen, levels


def _nearest(
    height: Tensor, node: Tensor, floor: Tensor, span: float, around: list[tuple[int, int]]
) -> tuple[Tensor, Tensor]:
    """Return, around each node, the nearest one from 0 to `span` [m] above a floor [m], and its squared distance."""
    height, W = height.flatten(), height.shape[1]
    cost, best = torch.full_like(floor, torch.inf), node
    for i, j in around:
        there = node + (i * W + j)
        level = (height[there] - floor) / span
        new_cost = (i * i + j * j) + (1 - level) / 2  # prefers the higher of two nodes at the same distance
        is_better = ((level - 0.5).abs() < 0.501) & (new_cost < cost)  # level is from 0 to 1, with rounding
        cost, best = torch.where(is_better, new_cost, cost), torch.where(is_better, there, best)
    return best, cost


def highest_within(heights: Float[Tensor, "H W"], nodes: int) -> Float[Tensor, "H W"]:
    """Return the highest of the (2 nodes + 1)^2 heights around each node; the rim has fewer."""
    return F.max_pool2d(heights[None, None], 2 * nodes + 1, 1, padding=nodes)[0, 0]
