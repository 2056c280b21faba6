"""Windows by OpenCV: what some filters run on a CPU instead of tensor operations, to the same result.

For float32 layers without gradient, where OpenCV is installed. All in NumPy: torch's threads, which wait for their next
operation in a loop, would take OpenCV's their cores.
"""

from __future__ import annotations

import functools
from collections.abc import Callable

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from torchelev.layers import Layer

BLANK = float(np.finfo(np.float32).max / 4)  # beyond all heights


@functools.cache
def _installed() -> bool:
    try:
        import cv2  # noqa: F401
    except ImportError:  # not there, or without a library that it needs
        return False
    return True


def serves(values: Tensor) -> bool:
    """Tell whether OpenCV can filter these values: float32 on the CPU that no gradient is wanted of."""
    plain = type(values) is Tensor and not torch._C._functorch.is_functorch_wrapped_tensor(values)
    learns = values.requires_grad and torch.is_grad_enabled()
    float32 = values.device.type == "cpu" and values.dtype == torch.float32
    return plain and float32 and not learns and not torch.compiler.is_compiling() and _installed()


def masked(values: Tensor, known: Tensor) -> Layer:
    """Put 0 where nothing is known, and take what is not finite for unknown."""
    heights = values.detach().numpy()
    there = np.isfinite(heights) & known.numpy()
    return torch.from_numpy(filled(heights, there, 0.0)), torch.from_numpy(there)


def filled(values: NDArray, known: NDArray, blank: float) -> NDArray:
    """Return the values (B, H, W) where known, and `blank` elsewhere. NumPy's own masks take four times as long."""
    import cv2  # an optional dependency

    target = np.full(values.shape, blank, values.dtype)
    cv2.copyTo(_image(values), _image(known).view(np.uint8), _image(target))
    return target


def _image(maps: NDArray) -> NDArray:
    """Return maps (B, H, W) below one another, as one image."""
    return maps.reshape(-1, maps.shape[2])


def of_windows(function: Callable[[NDArray], NDArray], maps: NDArray, radius: int, blank: float) -> NDArray:
    """Run a function from image to image over maps (B, H, W), all at once: `radius` blank rows keep them apart."""
    B, H, W = maps.shape
    if B == 1:
        return function(maps[0])[None]
    apart = np.full((B, H + radius, W), blank, maps.dtype)
    apart[:, :H] = maps
    return function(_image(apart)).reshape(apart.shape)[:, :H]


def highest(layer: Layer, radius: int) -> Tensor:
    """Return the highest known cell of the window around each known cell."""
    import cv2

    heights, window = filled(*_arrays(layer), -BLANK), _square(radius)
    return torch.from_numpy(of_windows(lambda image: cv2.dilate(image, window), heights, radius, -BLANK))


def lowest(layer: Layer, radius: int) -> Tensor:
    """Return the lowest known cell of the window around each known cell."""
    import cv2

    heights, window = filled(*_arrays(layer), BLANK), _square(radius)
    return torch.from_numpy(of_windows(lambda image: cv2.erode(image, window), heights, radius, BLANK))


def box_mean(layer: Layer, radius: int) -> Tensor:
    """Return the mean of the known cells of the square window around each known cell. Summed in float64."""
    values, known = _arrays(layer)
    return torch.from_numpy(_box(values, radius) / np.maximum(_box(known, radius), 1))


def gaussian_mean(layer: Layer, radius: int, sigma: float) -> Tensor:
    """Return the mean of the known cells around each known cell, weighted by a Gaussian of `sigma` cells."""
    values, known = _arrays(layer)
    heights, datum = _from_datum(values, known)
    weights = np.maximum(_gaussian(known.astype(np.float32), radius, sigma), np.finfo(np.float32).tiny)
    return torch.from_numpy(_gaussian(heights, radius, sigma) / weights + datum)


def deviation(layer: Layer, radius: int, least: float) -> Tensor:
    """Return the standard deviation of the known cells of the window around each known cell, at least `least`."""
    import cv2

    values, known = _arrays(layer)
    heights, _ = _from_datum(values, known)
    number = np.maximum(_box(known, radius), 1)
    mean = _box(heights, radius) / number
    variance = np.maximum(_box(heights * heights, radius) / number - mean * mean, least**2)
    return torch.from_numpy(cv2.sqrt(_image(variance)).reshape(variance.shape))


def _arrays(layer: Layer) -> tuple[NDArray, NDArray]:
    return layer[0].detach().numpy(), layer[1].numpy()


def _square(radius: int) -> NDArray:
    return np.ones((2 * radius + 1, 2 * radius + 1), np.uint8)


def _from_datum(values: NDArray, known: NDArray) -> tuple[NDArray, NDArray]:
    """Return heights from each map's mean, 0 where unknown: sums of high ones would cost float32 its millimetres."""
    count = np.count_nonzero(known.reshape(len(known), -1), axis=1)
    datum = values.reshape(len(known), -1).sum(1) / np.maximum(count, 1)
    datum = datum.astype(np.float32)[:, None, None]
    return values - known.astype(np.float32) * datum, datum


def _box(values: NDArray, radius: int) -> NDArray:
    """Return the sums of square windows, of floats or of a mask."""
    import cv2

    width, border = (2 * radius + 1,) * 2, cv2.BORDER_CONSTANT
    images = values.view(np.uint8) if values.dtype == np.bool_ else values
    sums = functools.partial(cv2.boxFilter, ddepth=cv2.CV_32F, ksize=width, normalize=False, borderType=border)
    return of_windows(sums, images, radius, 0)


def _gaussian(values: NDArray, radius: int, sigma: float) -> NDArray:
    """Return the weighted sums of windows of floats."""
    import cv2

    width, border = (2 * radius + 1,) * 2, cv2.BORDER_CONSTANT
    return of_windows(lambda image: cv2.GaussianBlur(image, width, sigma, borderType=border), values, radius, 0)


def differs_from_a_side(values: NDArray, known: NDArray | None, limit: float, rim: float) -> NDArray:
    """Tell which cells differ by more than `limit` from one of the four beside them, `rim` lying around the map.

    With a mask, only known cells count, and nothing around the map does.
    """
    import cv2

    cross, border = cv2.getStructuringElement(cv2.MORPH_CROSS, (3, 3)), cv2.BORDER_CONSTANT
    low, high = (values, values) if known is None else (filled(values, known, end) for end in (-BLANK, BLANK))
    least, most = (rim, rim) if known is None else (-BLANK, BLANK)
    above = of_windows(lambda image: cv2.dilate(image, cross, borderType=border, borderValue=least), low, 1, least)
    below = of_windows(lambda image: cv2.erode(image, cross, borderType=border, borderValue=most), high, 1, most)
    differs = np.maximum(above - values, values - below) > limit
    return differs if known is None else differs & known
