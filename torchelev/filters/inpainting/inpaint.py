"""In-painting filters: heights for the cells of holes.

Height scans use another rule, `torchelev.observations.fill.inpaint`: ring by ring from the border inwards, the mean of
the known neighbours within the extent of the scan's points.
"""

from __future__ import annotations

import functools
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from typing import TYPE_CHECKING

import torch
from numpy.typing import NDArray
from torch import Tensor

from torchelev.errors import require_count, require_positive
from torchelev.filters import opencv
from torchelev.filters.extrema import blank, highest_of_windows, with_blanks
from torchelev.filters.inpainting.harmonic import four_sum, solve_laplace
from torchelev.filters.inpainting.holes import lowest_of_border, nearest_known
from torchelev.filters.layer_tools import known_weight, radius_cells
from torchelev.filters.registry import register
from torchelev.filters.smoothing import mean_of_known
from torchelev.layers import Layer
from torchelev.ops.masks import where_finite
from torchelev.ops.windows import padded

if TYPE_CHECKING:
    from jaxtyping import Bool

_UNITS = 1e6  # per metre, in OpenCV's images


@register
def inpaint_minimum(layer: Layer, *, iterations: int | None = None) -> Layer:
    """Fill each hole with the lowest height of its border, the paper's filter for occlusions (Sec. II-I.1).

    A hole is a set of unknown cells connected through eight neighbours, so a hole passes between two known cells that
    touch only at a corner. Its border is the known cells next to it; the map's rim does not count. A map without known
    cells stays unknown. The gradient goes to the lowest border cell: the first of equal ones, or with `iterations`
    shared among them.

    Args:
        layer: heights [m] and mask (B, H, W).
        iterations: steps through the hole within which border cells count for a cell; cells that reach none stay
            unknown. None: the whole border.

    Raises:
        ValueError: if `iterations` is below 1.
    """
    values, known = layer
    if iterations is None and opencv.is_usable(values):
        return opencv.fill_holes_with_minimum(layer)
    if iterations is None:
        return _gather(values, lowest_of_border(values.detach(), known))
    require_count("iterations", iterations, "give None for holes of any size")
    highest = with_blanks(-values, known)
    for _ in range(iterations):
        highest = _highest_around(highest, known)
    is_found = highest > blank(values.dtype) / 2
    return where_finite(known, values, -highest), known | is_found


def _gather(values: Tensor, source: Tensor) -> Layer:
    """Return the values at flat indices (B, H, W); an index past the last cell means unknown."""
    num_cells = values[0].numel()
    taken = values.flatten(1).gather(1, source.flatten(1).clamp(max=num_cells - 1))
    return taken.view_as(values), source < num_cells


def _highest_around(values: Tensor, known: Tensor) -> Tensor:
    """Return the highest of each unknown cell and its eight neighbours, and blank for known cells."""
    low = blank(values.dtype)
    return where_finite(~known, highest_of_windows(padded(values, 1, low), 3), low)


def _on_maps_with_ground(known: Bool[Tensor, "B H W"]) -> Bool[Tensor, "B H W"]:
    """Return true on maps that have a known cell."""
    return known | known.any(2, keepdim=True).any(1, keepdim=True)


@register
def inpaint_nearest(layer: Layer) -> Layer:
    """Fill each unknown cell with the height of the nearest known cell.

    By the exact distance between centres; of equally near cells, the one with the lowest index i, then j. A map without
    known cells stays unknown. The gradient goes to the nearest cell.
    """
    values, known = layer
    return _gather(values, nearest_known(known))


@register
def inpaint_diffusion(layer: Layer, *, tolerance: float = 1e-3, iterations: int = 40) -> Layer:
    """Fill holes by Laplace's equation: each unknown cell is the mean of its four neighbours, known cells are fixed.

    At the map's rim missing neighbours are left out, so that the surface ends level there. Filled heights stay within
    the range of the border's. A map without known cells stays unknown.

    By conjugate gradients. Maps of up to 512 x 512 cells took at most 27 steps. A CPU stops once all maps are solved;
    other devices take all steps, so that the host never waits. The gradient solves the same equations, to `tolerance`
    times its largest input.

    Args:
        layer: heights [m] and mask (B, H, W).
        tolerance: [m] approximate error, limited by the dtype.
        iterations: maximum number of steps.

    Raises:
        ValueError: if the tolerance is not positive or `iterations` is below 1.
    """
    values, known = layer
    require_positive(tolerance=tolerance)
    require_count("iterations", iterations, "give 40")
    weight = known_weight(known, values.dtype)
    datum = mean_of_known(values, weight)  # absolute heights would cost float32 its millimetres
    unknown = 1 - weight
    heights = (values - datum) * weight
    filling = solve_laplace(unknown, four_sum(heights) * unknown, tolerance, iterations) + datum
    return where_finite(known, values, filling), _on_maps_with_ground(known)


@register
def inpaint_telea(layer: Layer, *, resolution: float, radius: float = 0.2) -> Layer:
    """Fill holes from their border inwards by OpenCV's fast marching method (Telea 2004).

    Each cell is a weighted mean of the known and filled cells within the radius. Heights stay float32, not 8 bits. Runs
    on the host, map by map; filled cells have no gradient. A map without known cells stays unknown. Needs OpenCV 4.10
    or later.

    Args:
        layer: heights [m] and mask (B, H, W).
        resolution: [m] of a cell.
        radius: [m] within which cells count, rounded to cells, at least one.

    Raises:
        ValueError: if the radius is not positive.
    """
    import cv2

    return _inpaint_opencv(layer, radius_cells(radius, resolution), cv2.INPAINT_TELEA)


@register
def inpaint_navier_stokes(layer: Layer, *, resolution: float, radius: float = 0.2) -> Layer:
    """Fill holes along lines of equal height, by OpenCV's Navier-Stokes method (Bertalmio 2001).

    Arguments, device and gradient as for `inpaint_telea`.
    """
    import cv2

    return _inpaint_opencv(layer, radius_cells(radius, resolution), cv2.INPAINT_NS)


def _inpaint_opencv(layer: Layer, radius: int, method: int) -> Layer:
    """Fill the holes of each map by OpenCV, in micrometres.

    OpenCV adds a vector of length one to each height that it makes, and treats gradients below a hundredth as zero; in
    metres both would show.
    """
    values, known = layer
    if values.numel() == 0:
        return layer
    weight = known_weight(known, values.dtype)
    datum = mean_of_known(values, weight)
    heights = ((values.detach() - datum) * _UNITS * weight).float().cpu()
    images = _with_two_lines(heights).numpy(), _with_two_lines((~known).byte().cpu()).numpy()
    filled = _map_in_threads(functools.partial(_inpaint_image, radius=radius, method=method), *images)
    H, W = known.shape[1:]
    filling = torch.stack([torch.from_numpy(image) for image in filled])[:, :H, :W].to(values) / _UNITS + datum
    return torch.where(known, values, filling), _on_maps_with_ground(known)


def _map_in_threads(function: Callable[..., NDArray], *images: NDArray) -> list[NDArray]:
    """Run a function on each map, in parallel: OpenCV's in-painting is single-threaded.

    A single map stays in this thread; another thread would wait for a core that torch's threads hold.
    """
    threads = min(torch.get_num_threads(), len(images[0]))
    if threads == 1:
        return list(map(function, *images))
    with ThreadPoolExecutor(threads) as pool:
        return list(pool.map(function, *images))


def _inpaint_image(image: NDArray, holes: NDArray, radius: int, method: int) -> NDArray:
    import cv2

    return image if holes.all() else cv2.inpaint(image, holes, radius, method)


def _with_two_lines(images: Tensor) -> Tensor:
    """Repeat the only row or column of images (B, H, W): for single ones OpenCV reads beyond its memory."""
    H, W = images.shape[1:]
    return images.expand(-1, max(2, H), max(2, W)).contiguous()


@register
def fill_from(layer: Layer, other: Layer) -> Layer:
    """Fill unknown cells with another layer's values, for example `upper_bound`; known where either layer is."""
    values, known = layer
    other_values, other_known = other
    return where_finite(known, values, other_values), known | other_known
