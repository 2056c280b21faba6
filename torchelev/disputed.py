"""Cells whose points disagree: their robust mean, their step if they hold one, and how to work on them alone.

Few cells are disputed, but each costs several rounds over its points. So a CPU picks out those cells and their points;
a GPU, which would have to wait for the host to learn how many there are, goes through all. Nothing here has a
gradient: a height is a guess around which `fusion` averages.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import torch
from torch import Tensor

from torchelev.edges import EdgeConfig, side_of_step

if TYPE_CHECKING:
    from jaxtyping import Float, Int, UInt8

STEP, UNTRUSTED = 1, 2  # marks of disputed cells, see `dispute`


class Disputed:
    """K disputed cells, numbered across environments, and their P points; on a GPU all cells and all points."""

    def __init__(
        self,
        marks: UInt8[Tensor, "B C"],
        slot: Int[Tensor, "B M"],
        mean: Float[Tensor, "B C"],
        columns: list[Tensor],
    ) -> None:
        """Pick out the cells whose mark is not zero, and of their points z, spread, weight, passed, ray x and y."""
        self.shape = marks.shape
        first = torch.arange(marks.shape[0], device=marks.device)[:, None] * marks.shape[1]
        slot, columns = (slot + first).flatten(), [column.flatten() for column in columns]
        if marks.device.type == "cpu":
            marked = marks.flatten()
            self.cells = marked.nonzero().squeeze(1)
            chosen = marked.index_select(0, slot).nonzero().squeeze(1)
            number = torch.empty(marks.numel(), dtype=torch.int64)
            number[self.cells] = torch.arange(len(self.cells))
            self.owner = number.index_select(0, slot.index_select(0, chosen))
            columns = [column.index_select(0, chosen) for column in columns]
        else:
            self.cells, self.owner = torch.arange(marks.numel(), device=marks.device), slot
        self.mean = self.of(mean)
        z, self.spread, self.weight, self.passed, *self.ray = columns
        self.z = z - self.at_points(self.mean)  # [m] above the mean of the cell's points
        self.used = (self.weight > 0).to(z.dtype)

    def sum(self, values: Tensor) -> Tensor:
        """Sum the points' values (..., P) per cell: -> (..., K)."""
        total = values.new_zeros(*values.shape[:-1], len(self.cells))
        return total.scatter_add_(-1, self.owner.expand(values.shape), values)

    def highest(self, values: Tensor) -> Tensor:
        """Return the highest of the points' values (..., P) per cell: -> (..., K)."""
        highest = values.new_full((*values.shape[:-1], len(self.cells)), -torch.inf)
        return highest.scatter_reduce_(-1, self.owner.expand(values.shape), values, "amax")

    def at_points(self, values: Tensor) -> Tensor:
        """Give each point its cell's value: (..., K) -> (..., P)."""
        return values.index_select(-1, self.owner)

    def of(self, layer: Tensor) -> Tensor:
        """Read a layer (B, C) at the disputed cells: -> (K,)."""
        return layer.flatten().index_select(0, self.cells)

    def spread_out(self, *values: Tensor) -> Tensor:
        """Make layers of the cells' values, zero elsewhere: n times (K,) -> (n, B, C)."""
        layers = values[0].new_zeros(len(values), self.shape.numel())
        return layers.index_copy_(1, self.cells, torch.stack(values)).unflatten(1, self.shape)


def robust_mean(points: Disputed) -> Tensor:
    """Return each cell's robust mean (K,) [m] above its mean.

    From the mean on, twice: the mean under the weights w / (1 + r^2 / sigma^2)^2 of the residuals r, which leave an
    outlier out.
    """
    height = torch.zeros_like(points.mean)
    for _ in range(2):
        residual = points.z - points.at_points(height)
        reduced = points.weight / (1.0 + residual.square() / points.spread).square()
        moment, total = points.sum(torch.stack([reduced * residual, reduced])).unbind(0)
        height = height + moment / total.clamp(min=torch.finfo(total.dtype).tiny)
    return height


@torch.library.custom_op(
    "torchelev::dispute",
    mutates_args=(),
    schema="(Tensor marks, Tensor slot, Tensor[] columns, Tensor mean, Tensor shown, SymInt width, float gate, "
    "float relief, float[] edges) -> Tensor",
)
def dispute(
    marks: UInt8[Tensor, "B C"],
    slot: Int[Tensor, "B M"],
    columns: list[Tensor],
    mean: Float[Tensor, "B C"],
    shown: Float[Tensor, "2 B C"],
    width: int,
    gate: float,
    relief: float,
    edges: list[float],
) -> Float[Tensor, "2 B C"]:
    """Return the height [m] of each disputed cell and its side: of a step +1 top, -1 ground, else 0.

    The mark of an UNTRUSTED cell asks for the robust mean of its points unless too many of them are far from that,
    that of a STEP for the height of one of its ends. Where there is no mark, the results are zero, or mean nothing.
    `columns` (B, M) are those of `Disputed`, the weight zero where a point is not used; `shown` holds the heights that
    the scan and the map show, `width` counts cells along y, `relief` is in [m], `edges` is `EdgeConfig.numbers`, or
    empty if steps do not matter.
    """
    points = Disputed(marks, slot, mean, columns)
    height = robust_mean(points)
    if not edges:
        return points.spread_out(points.mean + height, torch.zeros_like(height))
    residual = points.z - points.at_points(height)
    near = points.used * (residual.square() <= gate**2 * points.spread)
    number, close = points.sum(torch.stack([points.used, near])).unbind(0)
    cfg = EdgeConfig.of(edges)
    step = (number >= cfg.min_points) & (number - close >= cfg.min_share * number) | (points.of(marks) == STEP)
    side, end = side_of_step(points, shown.flatten(1), width, relief, cfg)
    height = points.mean + torch.where(step, end, height)
    return points.spread_out(height, torch.where(step, side, 0.0))


@dispute.register_fake
def _(marks: Tensor, slot: Tensor, columns: list[Tensor], mean: Tensor, *others: Any) -> Tensor:
    return mean.new_empty(2, *mean.shape)
