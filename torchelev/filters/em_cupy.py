"""The plugins of elevation_mapping_cupy that change heights, as it computes them: for maps that were tuned to them.

Filters of this library do the same without their limits: `inpaint_minimum`, `box`, `inpaint_telea`, `erosion`.
"""

from __future__ import annotations

import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor

from torchelev.errors import require, require_count
from torchelev.filters.registry import register
from torchelev.layers import Layer

_LEVELS = 255  # of the images that its filters make of a layer


@register
def em_cupy_min_filter(layer: Layer, *, dilation_size: int = 5, iteration_n: int = 5) -> Layer:
    """Fill unknown cells with the lowest height around them, again and again, as the plugin `min_filter`.

    A filled cell reads anew in each iteration, so that low ground spreads as far as the iterations go, also across
    known cells. A map whose cells are all filled is done. What its kernel leaves to chance, the order of the cells, is
    fixed here: a cell reads what was there before the iteration.

    Args:
        layer: heights [m] and mask (B, H, W).
        dilation_size: [cells] half the side of the window.
        iteration_n: largest number of iterations.

    Raises:
        ValueError: if a number is below 1.
    """
    require_count("dilation_size", dilation_size, "give cells")
    require_count("iteration_n", iteration_n, "give the number of iterations")
    values, known = layer
    low, filled = torch.where(known, values, torch.inf), known
    for _ in range(iteration_n):
        is_done = filled.flatten(1).all(1)[:, None, None]
        lowest = -F.max_pool2d(-low[:, None], 2 * dilation_size + 1, 1, dilation_size)[:, 0]
        low = torch.where(known | is_done, low, lowest)
        filled = low < torch.inf
    return torch.where(filled, low, 0.0), filled


@register
def em_cupy_max_filter(layer: Layer, *, dilation_size: int = 5, iteration_n: int = 5) -> Layer:
    """Fill unknown cells with the highest height around them, as the plugin `max_filter`.

    A cell keeps what it was first filled with. Arguments and errors as for `em_cupy_min_filter`.
    """
    require_count("dilation_size", dilation_size, "give cells")
    require_count("iteration_n", iteration_n, "give the number of iterations")
    values, filled = layer
    high = torch.where(filled, values, -torch.inf)
    for _ in range(iteration_n):
        highest = F.max_pool2d(high[:, None], 2 * dilation_size + 1, 1, dilation_size)[:, 0]
        high = torch.where(filled, high, highest)
        filled = high > -torch.inf
    return torch.where(filled, high, 0.0), filled


@register
def em_cupy_smooth_filter(layer: Layer) -> Layer:
    """Take the mean of 3 x 3 cells twice, as the plugin `smooth_filter`: one unknown cell makes the mean unknown.

    Beyond the rim the cells of the rim count once more.
    """
    values, known = layer
    for _ in range(2):
        values = F.avg_pool2d(_with_rim(values), 3, 1)[:, 0]
        known = F.avg_pool2d(_with_rim(known.to(values.dtype)), 3, 1)[:, 0] > 1 - 1e-3
    return torch.where(known, values, 0.0), known


def _with_rim(values: Tensor) -> Tensor:
    return F.pad(values[:, None], (1, 1, 1, 1), mode="replicate")  # of one cell, "symmetric" is the same


@register
def em_cupy_inpainting(layer: Layer, *, method: str = "telea") -> Layer:
    """Fill holes by OpenCV in 255 levels between the lowest and the highest height, as the plugin `inpainting`.

    All heights become one of the levels, known ones too. Runs on the host; no gradient.

    Args:
        layer: heights [m] and mask (B, H, W).
        method: "telea" or "ns", Navier-Stokes.

    Raises:
        ValueError: if there is no such method.
    """
    import cv2

    methods = {"telea": cv2.INPAINT_TELEA, "ns": cv2.INPAINT_NS}
    require(method in methods, "method", "must be telea or ns", repr(method), "use telea")
    filled = []
    for values, known in _host(layer):
        if not known.any():
            filled.append(values)
            continue
        image, low, step = _as_bytes(np.where(known, values, values[known].min()), known)
        image = cv2.inpaint(image, (~known).astype(np.uint8), 1, methods[method])
        filled.append(image.astype(np.float32) * step + low)
    has_ground = layer[1].flatten(1).any(1)[:, None, None].expand_as(layer[1])
    return torch.from_numpy(np.stack(filled)).to(layer[0]), has_ground


@register
def em_cupy_erosion(layer: Layer, *, kernel_size: int = 3, iterations: int = 1, reverse: bool = False) -> Layer:
    """Take the lowest value of the window in 255 levels, as the plugin `erosion`.

    Unknown cells count as 0. Runs on the host; no gradient.

    Args:
        layer: values, for instance of traversability, and mask (B, H, W).
        kernel_size: [cells] side of the window.
        iterations: how often.
        reverse: erode 1 - value, which widens what is low.

    Raises:
        ValueError: if a number is below 1.
    """
    import cv2

    require_count("kernel_size", kernel_size, "give cells")
    require_count("iterations", iterations, "give the number of iterations")
    eroded = []
    for values, known in _host(layer):
        given = np.where(known, values, 0.0).astype(np.float32)
        given = 1 - given if reverse else given
        image, low, step = _as_bytes(given, np.ones_like(known))
        image = cv2.erode(image, np.ones((kernel_size, kernel_size), np.uint8), iterations=iterations)
        result = image.astype(np.float32) * step + low
        eroded.append(1 - result if reverse else result)
    return torch.from_numpy(np.stack(eroded)).to(layer[0]), layer[1]


def _host(layer: Layer) -> list[tuple[np.ndarray, np.ndarray]]:
    """Return each map's values in float32 and mask."""
    values, known = layer
    return list(zip(values.detach().float().cpu().numpy(), known.cpu().numpy(), strict=True))


def _as_bytes(values: np.ndarray, known: np.ndarray) -> tuple[np.ndarray, np.float32, np.float32]:
    """Return values as levels, the lowest known one, and the height of a level."""
    low, high = values[known].min(), values[known].max()
    relief = high - low if high > low else np.float32(1.0)
    return ((values - low) * _LEVELS / relief).astype(np.uint8), low, np.float32(relief / _LEVELS)
