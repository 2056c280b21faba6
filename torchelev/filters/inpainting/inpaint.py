"""In-painting: heights for the cells of holes.

`torchelev.observations.fill.inpaint`, which height scans use, is another rule and none of the filters here: from the
border inwards, ring by ring, the mean of the known neighbours, and only as far as a scan's points lie.
"""

from __future__ import annotations

import functools
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor

import torch
from numpy.typing import NDArray
from torch import Tensor

from torchelev.errors import require_count, require_positive
from torchelev.filters import opencv
from torchelev.filters.extrema import blank, highest_of_windows, lowered
from torchelev.filters.inpainting.harmonic import four_sum, harmonic
from torchelev.filters.inpainting.holes import lowest_of_border, nearest_known
from torchelev.filters.registry import radius_cells, register
from torchelev.filters.smoothing import mean_of_known
from torchelev.layers import Layer
from torchelev.ops.operators import padded
from torchelev.ops.storage import as_bytes

UNITS = 1e6  # per metre, for OpenCV


@register
def inpaint_minimum(layer: Layer, *, iterations: int | None = None) -> Layer:
    """Give each hole the lowest height of its border, the filter for occlusions (paper, Sec. II-I.1).

    A hole is unknown cells that eight neighbours connect; its border is the known cells among their neighbours. So a
    hole passes between two known cells that touch by a corner only. The map's rim is no border. With `iterations`, a
    cell takes the lowest of the border cells that lie within as many steps through the hole, and cells from which none
    does stay unknown; by default of all. Where a map knows nothing, nothing becomes known.

    The gradient goes to the lowest border cell: of equal ones to the first, or with `iterations` in parts to all.
    Raises ValueError for `iterations` below 1.
    """
    values, known = layer
    if iterations is None and opencv.serves(values):
        return opencv.lowest_of_holes(layer)
    if iterations is None:
        return _taken(values, lowest_of_border(values.detach(), known))
    require_count("iterations", iterations, "give None for holes of any size")
    highest = lowered(-values, as_bytes(known).to(values.dtype))
    for _ in range(iterations):
        highest = _highest_around(highest, known)
    found = highest > blank(values.dtype) / 2
    return torch.where(known, values, -highest), known | found


def _taken(values: Tensor, source: Tensor) -> Layer:
    """Return the values of the cells of these numbers; beyond the last there is none."""
    found = source < values[0].numel()
    taken = values.flatten(1).gather(1, source.flatten(1).clamp(max=values[0].numel() - 1))
    return taken.view_as(values), found


def _highest_around(values: Tensor, known: Tensor) -> Tensor:
    """Return the highest of each cell and its eight neighbours where unknown, and nothing where known."""
    low = blank(values.dtype)
    return torch.where(known, low, highest_of_windows(padded(values, 1, low), 3))


@register
def inpaint_nearest(layer: Layer) -> Layer:
    """Give each unknown cell the height of the nearest known cell, by the distance of their centres.

    Exact; of several that are as near, the one of the lowest index i, then j. Where a map knows nothing, nothing
    becomes known. The gradient goes to the nearest cell.
    """
    values, known = layer
    return _taken(values, nearest_known(known))


@register
def inpaint_diffusion(layer: Layer, *, tolerance: float = 1e-3, iterations: int = 40) -> Layer:
    """Span each hole by a membrane: every unknown cell is the mean of its four neighbours (Laplace's equation).

    The known cells are fixed. At the map's rim the missing neighbours are left out, so that the membrane ends level
    there. No height lies outside of the range of the border's.

    Solved to an error of about `tolerance` [m], as far as the dtype goes, by at most `iterations` steps of conjugate
    gradients; of the maps tried, up to 512 x 512 cells, none took more than 27. A CPU stops when all maps are solved;
    elsewhere all steps are made, so that the host never waits. Where a map knows nothing, nothing becomes known.

    Differentiable: the gradient is the solution of the same equations, to `tolerance` times its largest input.
    Raises ValueError for a tolerance that is not positive and `iterations` below 1.
    """
    values, known = layer
    require_positive(tolerance=tolerance)
    require_count("iterations", iterations, "give 40")
    weight = as_bytes(known).to(values.dtype)
    # From the map's mean, so that float32 keeps its millimetres.
    datum = mean_of_known(values, weight)
    unknown = 1 - weight
    heights = (values - datum) * weight
    spanned = harmonic(unknown, four_sum(heights) * unknown, tolerance, iterations) + datum
    return values + spanned * unknown, known | known.any(2, keepdim=True).any(1, keepdim=True)


@register
def inpaint_telea(layer: Layer, *, resolution: float, radius: float = 0.2) -> Layer:
    """Fill holes from their border inwards by OpenCV's fast marching method (Telea 2004).

    Each cell is a weighted mean of the known and filled cells within `radius` [m]. Heights stay float32 numbers: they
    are not put into 8 bits. Computed on the host, map by map; no gradient reaches the filled cells. Where a map knows
    nothing, nothing becomes known. OpenCV 4.10 or later. Raises ValueError for a radius that is not positive.
    """
    import cv2

    return _inpainted(layer, radius_cells(radius, resolution), cv2.INPAINT_TELEA)


@register
def inpaint_navier_stokes(layer: Layer, *, resolution: float, radius: float = 0.2) -> Layer:
    """Fill holes along lines of equal height, by OpenCV's method after Navier and Stokes (Bertalmio 2001).

    All else as of `inpaint_telea`.
    """
    import cv2

    return _inpainted(layer, radius_cells(radius, resolution), cv2.INPAINT_NS)


def _inpainted(layer: Layer, radius: int, method: int) -> Layer:
    """Fill the holes of each map by OpenCV, in millionths of a metre.

    It adds a vector of length one to each height that it makes, and takes gradients below a hundredth for none: in
    metres both would show.
    """
    values, known = layer
    if values.numel() == 0:
        return layer
    weight = as_bytes(known).to(values.dtype)
    datum = mean_of_known(values, weight)
    heights = ((values.detach() - datum) * UNITS * weight).float().cpu()
    images = _two_lines(heights).numpy(), _two_lines((~known).byte().cpu()).numpy()
    filled = _of_each(functools.partial(_filled, radius=radius, method=method), *images)
    found = known.any(2, keepdim=True).any(1, keepdim=True)
    H, W = known.shape[1:]
    filling = torch.stack([torch.from_numpy(image) for image in filled])[:, :H, :W].to(values) / UNITS + datum
    return torch.where(known, values, filling), known | found


def _of_each(function: Callable[..., NDArray], *images: NDArray) -> list[NDArray]:
    """Run a function for each map, one for each thread at a time: OpenCV fills a map by a single one.

    A map that is alone stays in this thread; another would have to wait for a core that torch's threads hold.
    """
    threads = min(torch.get_num_threads(), len(images[0]))
    if threads == 1:
        return list(map(function, *images))
    with ThreadPoolExecutor(threads) as pool:
        return list(pool.map(function, *images))


def _filled(image: NDArray, holes: NDArray, radius: int, method: int) -> NDArray:
    import cv2

    return image if holes.all() else cv2.inpaint(image, holes, radius, method)


def _two_lines(images: Tensor) -> Tensor:
    """Repeat the only row or column of images (B, H, W): of a single one OpenCV reads beyond its memory."""
    H, W = images.shape[1:]
    return images.expand(-1, max(2, H), max(2, W)).contiguous()


@register
def fill_from(layer: Layer, other: Layer) -> Layer:
    """Take the other layer's values where the first is unknown and the other is known: `upper_bound`, for example."""
    values, known = layer
    others, others_known = other
    return values + others * (1 - as_bytes(known).to(values.dtype)), known | others_known
