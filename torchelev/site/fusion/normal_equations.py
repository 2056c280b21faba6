"""The normal equations of the offsets and tilts of many windows, which few others overlap."""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

import torch
from torch import Tensor

if TYPE_CHECKING:
    from jaxtyping import Float, Int

_TILT_STD = 0.05  # [rad] a priori, which keeps windows with little overlap level
_DENSE = 300  # unknowns up to which a factorisation is faster than iterating
_MAX_STEPS = 200  # of conjugate gradients: long chains of windows take more, and are factorised
_TOLERANCE = 1e-24  # of the residual's square


class Edges(NamedTuple):
    """Which of M windows, of which the last one is the site, are compared with each other."""

    ends: Int[Tensor, "U 2"]  #: both windows
    number: int  #: M

    def factors(self, unknowns: Float[Tensor, "M size"]) -> Float[Tensor, "m U"]:
        """Return the factors of 1, x_a, y_a, x_b, y_b [m] of each edge's differences."""
        both = unknowns[self.ends].flatten(1, 2)
        return _to_columns(unknowns.shape[1], both.device) @ both.T


class Gauge(NamedTuple):
    """The windows of each group without the site, whose mean offset is fixed: those with one before, or all."""

    group: Int[Tensor, "M"]  #: lowest number of the group
    counts: Float[Tensor, "M"]  #: 1 of these windows, 0 of others
    target: Float[Tensor, "M"]  #: [m] sum of the group's last offsets, at its lowest number

    def of_groups(self, offsets: Float[Tensor, "M"]) -> Float[Tensor, "M"]:
        """Return the sum of a group's offsets, for each of its windows that counts."""
        return self.counts * self.sum(offsets)[self.group]

    def sum(self, offsets: Float[Tensor, "M"]) -> Float[Tensor, "M"]:
        """Return the sums of the groups' offsets, at their lowest numbers."""
        return torch.zeros_like(offsets).index_add_(0, self.group, self.counts * offsets)


def solve(
    edges: Edges,
    moments: Float[Tensor, "U m m+1"],
    groups: Int[Tensor, "M"],
    before: Float[Tensor, "N"],
    start: Float[Tensor, "M size"],
) -> Float[Tensor, "M size"]:
    """Solve for all windows; the site's unknowns are 0.

    Args:
        edges: between windows.
        moments: weighted sums of all products of columns with columns, and with the difference, per edge.
        groups: of windows that are connected, by their lowest number.
        before: [m] offsets of the last merge, NaN of windows that have not contributed yet.
        start: unknowns to begin with.
    """
    size = start.shape[1]
    factors = _to_columns(size, start.device)
    blocks = (factors.T @ moments[..., :-1] @ factors).view(-1, 2, size, 2, size)
    right = torch.zeros_like(start).index_add_(0, edges.ends.flatten(), (moments[..., -1] @ factors).view(-1, size))
    gauge = find_gauge(groups, before)
    right[:, 0] += gauge.counts * gauge.target[gauge.group]
    right[-1] = 0.0
    solution = None
    if len(start) * size > _DENSE and not start.is_cuda:
        solution = _iterate(edges, blocks, right, gauge, start)
    return _factorise(edges, blocks, right, gauge) if solution is None else solution


def find_gauge(groups: Int[Tensor, "M"], before: Float[Tensor, "N"]) -> Gauge:
    """Return which windows' mean offsets are fixed."""
    had, is_free = torch.cat([before.isfinite(), before.new_zeros(1, dtype=torch.bool)]), groups != groups[-1]
    any_had = torch.zeros_like(had).index_fill_(0, groups[had], True)
    counts = (is_free & (had | ~any_had[groups])).double()
    gauge = Gauge(groups, counts, torch.zeros_like(counts))
    return gauge._replace(target=gauge.sum(torch.cat([before.nan_to_num(nan=0.0), before.new_zeros(1)])))


def _to_columns(size: int, device: torch.device) -> Float[Tensor, "m 2s"]:
    """Return the matrix that takes the unknowns of both ends of a pair to the factors of 1, x_a, y_a, x_b, y_b."""
    if size == 1:
        return torch.tensor([[1.0, -1.0]], dtype=torch.float64, device=device)
    factors = torch.zeros(5, 6, dtype=torch.float64)
    factors[0, 0], factors[0, 3] = 1.0, -1.0
    factors[range(1, 5), (1, 2, 4, 5)] = torch.tensor([1.0, 1.0, -1.0, -1.0], dtype=torch.float64)
    return factors.to(device)


def _factorise(edges: Edges, blocks: Tensor, right: Tensor, gauge: Gauge) -> Float[Tensor, "M size"]:
    """Solve by a dense Cholesky factorisation."""
    ends, (M, size) = edges.ends, right.shape
    place = (ends[:, :, None] * M + ends[:, None]).flatten()
    flat = blocks.transpose(2, 3).reshape(-1, size, size)
    A = flat.new_zeros(M * M, size, size).index_add_(0, place, flat).view(M, M, size, size)
    A.diagonal(dim1=2, dim2=3)[range(M), range(M), 1:] += _TILT_STD**-2
    A[:, :, 0, 0] += (gauge.group[:, None] == gauge.group) * gauge.counts[:, None] * gauge.counts
    A[-1], A[:, -1] = 0.0, 0.0
    A[-1, -1] = torch.eye(size, device=A.device)
    L = torch.linalg.cholesky(A.transpose(1, 2).reshape(M * size, M * size))
    return torch.cholesky_solve(right.view(-1, 1), L).view(M, size)


def _iterate(
    edges: Edges, blocks: Tensor, right: Tensor, gauge: Gauge, start: Tensor
) -> Float[Tensor, "M size"] | None:
    """Solve by conjugate gradients, preconditioned by the blocks of the windows; None: too slow."""
    ends, (M, size) = edges.ends, right.shape
    own = blocks.diagonal(dim1=1, dim2=3).permute(0, 3, 1, 2)
    diagonal = blocks.new_zeros(M, size, size).index_add_(0, ends.flatten(), own.reshape(-1, size, size))
    diagonal.diagonal(dim1=1, dim2=2)[:, 1:] += _TILT_STD**-2
    between = blocks[:, 0, :, 1, :].contiguous()
    # The mean of a group is free otherwise, so that any weight fixes it: one like those of the heights converges.
    strength = (gauge.sum(diagonal[:, 0, 0]) / gauge.sum(gauge.counts).clamp(min=1).square())[gauge.group]
    strength = torch.where(strength > 0, strength, 1.0)
    right = right.clone()
    right[:, 0] += gauge.counts * (strength - 1) * gauge.target[gauge.group]
    right[-1] = 0.0
    own_gauge = diagonal.clone()
    own_gauge[:, 0, 0] += gauge.counts * strength
    own_gauge[-1] = torch.eye(size, dtype=right.dtype)
    inverse = torch.linalg.inv(own_gauge)

    def multiply(x: Tensor) -> Tensor:
        a, b = x.index_select(0, ends[:, 0]), x.index_select(0, ends[:, 1])
        y = _apply(diagonal, x).index_add_(0, ends[:, 0], _apply(between, b))
        y.index_add_(0, ends[:, 1], _apply(between.transpose(1, 2), a))
        y[:, 0] += strength * gauge.of_groups(x[:, 0])
        y[-1] = 0.0
        return y

    x = start.clone()
    residual = right - multiply(x)
    step = _apply(inverse, residual)
    error, limit = (residual * step).sum(), _TOLERANCE * (right * _apply(inverse, right)).sum()
    direction = step
    for _ in range(_MAX_STEPS):
        if error <= limit:
            return x
        along = multiply(direction)
        length = error / (direction * along).sum()
        x += length * direction
        residual -= length * along
        step = _apply(inverse, residual)
        error, last = (residual * step).sum(), error
        direction = step + (error / last) * direction
    return None


def _apply(matrices: Float[Tensor, "K s s"], vectors: Float[Tensor, "K s"]) -> Float[Tensor, "K s"]:
    return matrices[:, 0] * vectors if vectors.shape[1] == 1 else (matrices @ vectors[..., None])[..., 0]
