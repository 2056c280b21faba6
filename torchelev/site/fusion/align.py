"""Offsets: how much each robot's heights lie above the site's, from the ground that they have in common."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import TYPE_CHECKING, NamedTuple

import torch
from torch import Tensor

from torchelev.site.fusion.windows import Alignment, Windows
from torchelev.site.site_config import SiteConfig

if TYPE_CHECKING:
    from jaxtyping import Bool, Float, Int

_NEIGHBORS = 8  # windows of a cell that each window is compared with; the others follow through these
_MAX_PAIRS = 1 << 17
_ROUNDS = 8  # of reweighting
_WIDEST = 0.5  # [m] scale of the first round; it halves until it is the noise
_CONVERGED = 1e-6  # [m]
_TILT_STD = 0.05  # [rad] a priori, which keeps windows with little overlap level


class Pairs(NamedTuple):
    """Heights of the same cell in two windows, or in a window and the site."""

    first: Int[Tensor, "P"]  #: window
    second: Int[Tensor, "P"]  #: window; B: the site
    difference: Float[Tensor, "P"]  #: [m] first - second
    variance: Float[Tensor, "P"]  #: [m^2] of the difference
    position: Float[Tensor, "P 2 2"]  #: [m] of the cell, from the centres of both windows


ReadSite = Callable[[Tensor, Tensor], tuple[Tensor, Tensor]]  # cell numbers x, y (K,) -> elevation, variance (K,)


def align(
    windows: Windows,
    read_site: ReadSite,
    resolution: float,
    cfg: SiteConfig,
    with_tilt: bool,
    max_difference: float = math.inf,
) -> Alignment:
    """Find the offsets by robust least squares over all pairs of overlapping windows, and of windows and the site.

    Minimises the sum of rho((h_a - o_a) - (h_b - o_b)) over the cells that are flat and certain in both, with o = 0 for
    the site. Windows that overlap each other but not the site keep the mean of their last offsets, or 0. rho is that
    of Geman and McClure, made narrower from round to round, so that moved objects do not count.

    Args:
        windows: B windows.
        read_site: returns the site's elevation, NaN where unknown, and variance at cells.
        resolution: [m].
        cfg: settings.
        with_tilt: also find how the windows tilt.
        max_difference: [m] beyond which heights, less the last offsets, are those of different levels.
    """
    B = len(windows.known.corner)
    pairs = find_pairs(windows, read_site, resolution, cfg, max_difference)
    count = torch.bincount(pairs.first * (B + 1) + pairs.second, minlength=(B + 1) ** 2).view(B + 1, B + 1)
    overlap = count + count.T >= cfg.min_overlap
    pairs = Pairs(*(value[overlap[pairs.first, pairs.second]] for value in pairs))
    groups = find_groups(overlap)
    unknowns = _solve(pairs, groups, _known_offsets(windows), 3 if with_tilt else 1)
    tilt = unknowns[:, 1:] if with_tilt else unknowns.new_zeros(B, 2)
    return Alignment(unknowns[:, 0], tilt, ~overlap[:B].any(1))


def _known_offsets(windows: Windows) -> Float[Tensor, "B"]:
    """Return the offsets of the last merge [m], NaN of windows that have not contributed yet."""
    contribution = windows.contribution
    if contribution is None:
        return torch.full(windows.known.now.shape, torch.nan, dtype=torch.float64, device=windows.known.now.device)
    return torch.where(contribution.known.is_known.flatten(1).any(1), contribution.alignment.offset, torch.nan)


def find_pairs(
    windows: Windows, read_site: ReadSite, resolution: float, cfg: SiteConfig, max_difference: float = math.inf
) -> Pairs:
    """Return the pairs of heights to compare, of cells that are flat and certain; arguments as of `align`."""
    window, x, y, height, variance = _comparable(windows, cfg)
    half = torch.tensor(windows.known.elevation.shape[1:], device=x.device) / 2 - 0.5
    position = (torch.stack([x, y], -1) - windows.known.corner[window] - half) * resolution
    site_height, site_variance = read_site(x, y)
    known = site_height.isfinite().nonzero()[:, 0]
    site = torch.full_like(known, len(windows.known.corner))
    found = [(window[known], site, (height - site_height)[known], (variance + site_variance)[known], known, known)]
    cell, order = torch.sort((x - x.min()) * (int(y.max() - y.min()) + 1) + (y - y.min()) if len(x) else x, stable=True)
    for apart in range(1, min(_NEIGHBORS, len(windows.known.corner) - 1) + 1):
        same = (cell[apart:] == cell[:-apart]).nonzero()[:, 0]
        if not len(same):
            break
        a, b = order[same], order[same + apart]
        found.append((window[a], window[b], height[a] - height[b], variance[a] + variance[b], a, b))
        if apart * len(cell) > _MAX_PAIRS:
            break
    first, second, difference, total, a, b = (torch.cat(column) for column in zip(*found, strict=True))
    pairs = Pairs(first, second, difference.double(), total.double(), torch.stack([position[a], position[b]], 1))
    if max_difference == math.inf:
        return pairs
    before = _known_offsets(windows).nan_to_num(nan=0.0)
    offset = torch.cat([before, before.new_zeros(1)])
    same = (pairs.difference - (offset[first] - offset[second])).abs() <= max_difference
    return Pairs(*(value[same] for value in pairs))


def _comparable(windows: Windows, cfg: SiteConfig) -> tuple[Tensor, ...]:
    """Return window, cell numbers x and y, height [m] and variance [m^2] of flat and certain cells, (K,) each."""
    known, corner = windows.known, windows.known.corner
    H, W = known.elevation.shape[1:]
    stride = math.ceil(math.sqrt(known.elevation.numel() / cfg.max_compared))
    # Of many windows, each keeps enough cells that overlaps are found.
    stride = max(1, min(stride, math.isqrt(H * W // (16 * cfg.min_overlap))))
    on_lattice = [
        (torch.arange(size, device=corner.device) + corner[:, axis, None]) % stride == 0
        for axis, size in enumerate((H, W))
    ]
    window, i, j = (on_lattice[0][:, :, None] & on_lattice[1][:, None]).nonzero().unbind(1)
    place = (window * H + i) * W + j
    read = [layer.reshape(-1).index_select(0, place) for layer in (*known[1:3], known.is_known, *windows[1:4])]
    height, variance, is_known, gradient_x, gradient_y, has_normal = read
    is_flat = has_normal & (gradient_x.square() + gradient_y.square() <= cfg.max_slope**2)
    good = (is_known & is_flat & (variance <= cfg.max_std**2)).nonzero()[:, 0]
    window, i, j, height, variance = (value[good] for value in (window, i, j, height, variance))
    height, variance = height.float(), variance.float()
    return window, corner[window, 0] + i, corner[window, 1] + j, height, variance


def find_groups(overlap: Bool[Tensor, "N N"]) -> Int[Tensor, "N"]:
    """Return for each window, and the site, the lowest number that it is connected with through overlaps."""
    N = len(overlap)
    lowest = torch.arange(N, device=overlap.device)
    while True:
        near = torch.where(overlap, lowest, N).amin(1).minimum(lowest)
        near = near[near]  # also takes over the result of the lowest one: halves the chains
        if torch.equal(near, lowest):
            return lowest
        lowest = near


def _solve(pairs: Pairs, groups: Int[Tensor, "N"], before: Float[Tensor, "B"], size: int) -> Float[Tensor, "B size"]:
    """Return the offsets and tilts by iteratively reweighted least squares, float64.

    The mean offset of a group that the site does not fix stays what it was `before`, or is 0.
    """
    N = len(groups)
    edges, edge = torch.unique(pairs.first * N + pairs.second, return_inverse=True)
    ends = torch.stack([edges // N, edges % N], 1)
    columns = [torch.ones_like(pairs.difference), *pairs.position.double().flatten(1).unbind(1)][
        : 1 if size == 1 else 5
    ]
    unknowns, scale = pairs.difference.new_zeros(N, size), _WIDEST
    for _ in range(_ROUNDS if len(edges) else 0):
        last = unknowns
        terms = (_to_columns(size, ends.device) @ (unknowns[ends].flatten(1, 2)[..., None]))[..., 0].T  # per edge
        residual = pairs.difference - sum(column * term[edge] for column, term in zip(columns, terms, strict=True))
        noise = 1.4826 * float(residual.abs().median())
        scale = max(noise, scale / 2)
        variance = pairs.variance.clamp(min=noise**2)
        weight = (1 + residual.square() / (9 * variance.clamp(min=scale**2))).square().reciprocal() / variance
        unknowns = _solve_normal_equations(
            _sum_moments(weight, columns, pairs.difference, edge, len(edges)), ends, groups, before, size
        )
        if scale == noise and (unknowns - last).abs().max() < _CONVERGED:
            break
    if not len(edges):
        unknowns[:-1, 0] = before.nan_to_num(nan=0.0)
    return unknowns[:-1]


def _to_columns(size: int, device: torch.device) -> Float[Tensor, "m 2s"]:
    """Return the matrix that takes the unknowns of both ends of a pair to the factors of 1, x_a, y_a, x_b, y_b."""
    if size == 1:
        return torch.tensor([[1.0, -1.0]], dtype=torch.float64, device=device)
    factors = torch.zeros(5, 6, dtype=torch.float64)
    factors[0, 0], factors[0, 3] = 1.0, -1.0
    factors[range(1, 5), (1, 2, 4, 5)] = torch.tensor([1.0, 1.0, -1.0, -1.0], dtype=torch.float64)
    return factors.to(device)


def _sum_moments(
    weight: Tensor, columns: list[Tensor], difference: Tensor, edge: Tensor, num_edges: int
) -> Float[Tensor, "U m m+1"]:
    """Return the weighted sums of all products of columns with columns, and with the difference, per edge."""
    total = weight.new_zeros(num_edges, len(columns), len(columns) + 1)
    for i, column in enumerate(columns):
        weighted = weight * column
        for j, factor in enumerate((*columns[: i + 1], difference)):
            place = j if j <= i else len(columns)
            total[:, i, place] = weight.new_zeros(num_edges).scatter_add_(0, edge, weighted * factor)
            if j < i:
                total[:, j, i] = total[:, i, j]
    return total


def _solve_normal_equations(
    total: Tensor, ends: Tensor, groups: Tensor, before: Tensor, size: int
) -> Float[Tensor, "N size"]:
    """Solve for all windows, given the moments of each edge's pairs."""
    N, factors = len(groups), _to_columns(size, groups.device)
    blocks = factors.T @ total[..., :-1] @ factors
    blocks = blocks.view(-1, 2, size, 2, size).transpose(2, 3).reshape(-1, size, size)
    place = (ends[:, :, None] * N + ends[:, None]).flatten()
    A = total.new_zeros(N * N, size, size).index_add_(0, place, blocks).view(N, N, size, size)
    right = (total[..., -1] @ factors).view(-1, size)
    b = total.new_zeros(N, size).index_add_(0, ends.flatten(), right)
    A.diagonal(dim1=2, dim2=3)[range(N), range(N), 1:] += _TILT_STD**-2
    gauge = _find_gauge(groups, before)
    A[:, :, 0, 0] += gauge.T @ gauge
    b[:, 0] += gauge.T @ (gauge[:, :-1] @ before.nan_to_num(nan=0.0))
    A[-1], A[:, -1], b[-1] = 0.0, 0.0, 0.0
    A[-1, -1] = torch.eye(size, device=A.device)
    L = torch.linalg.cholesky(A.transpose(1, 2).reshape(N * size, N * size))
    return torch.cholesky_solve(b.view(-1, 1), L).view(N, size)


def _find_gauge(groups: Int[Tensor, "N"], before: Float[Tensor, "B"]) -> Float[Tensor, "N N"]:
    """Return for each group without the site the windows whose mean offset is fixed: those with one before, or all."""
    member = groups == torch.arange(len(groups), device=groups.device)[:, None]
    member[groups[-1]] = False
    had = member & torch.cat([before.isfinite(), before.new_zeros(1, dtype=torch.bool)])
    return torch.where(had.any(1, keepdim=True), had, member).double()
