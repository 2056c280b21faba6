"""Windows and holes by OpenCV: what some filters run on a CPU instead of tensor operations, to the same result.

For float32 layers without gradient, where OpenCV is installed. All in NumPy: torch's threads, which wait for their next
operation in a loop, would take OpenCV's their cores. What comes out at unknown cells has no meaning, and may be NaN.
"""

from __future__ import annotations

import functools
import math

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


def reads(values: Tensor) -> bool:
    """Tell whether OpenCV is there and can read these values: plain ones on the CPU, outside compiled code."""
    plain = type(values) is Tensor and not torch._C._functorch.is_functorch_wrapped_tensor(values)
    return plain and values.is_cpu and not torch.compiler.is_compiling() and _installed()


def serves(values: Tensor) -> bool:
    """Tell whether OpenCV can filter these values: some, float32, that no gradient is wanted of, and that it reads."""
    learns = values.requires_grad and torch.is_grad_enabled()
    return values.dtype == torch.float32 and values.numel() > 0 and not learns and reads(values)


def masked(values: Tensor, known: Tensor) -> Layer:
    """Put 0 where nothing is known, and take what is not finite for unknown. Both come as copies."""
    import cv2  # an optional dependency

    there = _image(known.numpy()).copy()
    kept = cv2.copyTo(_image(values.detach().numpy()), there.view(np.uint8))  # into zeros
    # Summed in float64, which finite float32 numbers do not exceed: one pass tells that no cell needs a look.
    if not math.isfinite(cv2.sumElems(kept)[0]):
        there &= np.isfinite(kept)
        kept = cv2.copyTo(kept, there.view(np.uint8))
    return torch.from_numpy(kept.reshape(values.shape)), torch.from_numpy(there.reshape(values.shape))


def filled(values: NDArray, known: NDArray, blank: float) -> NDArray:
    """Return the values (B, H, W) where known, and `blank` elsewhere. NumPy's own masks take four times as long."""
    import cv2

    target = np.empty(values.shape, np.float32)
    target.fill(blank)
    cv2.copyTo(_image(values), _image(known).view(np.uint8), _image(target))
    return target


def arrays(layer: Layer) -> tuple[NDArray, NDArray]:
    """Return values and mask as arrays that share the layer's memory."""
    return layer[0].numpy(), layer[1].numpy()


def _image(maps: NDArray) -> NDArray:
    """Return maps (B, H, W) below one another, as one image."""
    return maps.reshape(-1, maps.shape[2])


def _apart(maps: NDArray, radius: int, blank: float) -> NDArray:
    """Return maps (B, H, W) below one another, as one image: `radius` blank rows keep the windows of each from others.

    For all of them together OpenCV takes three quarters of the time that it takes for one after the other.
    """
    B, H, W = maps.shape
    if B == 1:
        return maps[0]
    apart = np.empty((B, H + radius, W), maps.dtype)
    apart[:, :H], apart[:, H:] = maps, blank
    return _image(apart)


def _maps(image: NDArray, shape: tuple[int, ...]) -> NDArray:
    """Take the maps of a shape (B, H, W) from an image of them apart."""
    return image[None] if shape[0] == 1 else image.reshape(shape[0], -1, shape[2])[:, : shape[1]]


def highest(layer: Layer, radius: int) -> Tensor:
    """Return the highest known cell of the window around each known cell."""
    import cv2

    heights = _apart(filled(*arrays(layer), -BLANK), radius, -BLANK)
    return torch.from_numpy(_maps(cv2.dilate(heights, _square(radius), dst=heights), layer[0].shape))


def lowest(layer: Layer, radius: int) -> Tensor:
    """Return the lowest known cell of the window around each known cell."""
    import cv2

    heights = _apart(filled(*arrays(layer), BLANK), radius, BLANK)
    return torch.from_numpy(_maps(cv2.erode(heights, _square(radius), dst=heights), layer[0].shape))


def box_mean(layer: Layer, radius: int) -> Tensor:
    """Return the mean of the known cells of the square window around each known cell. Summed in float64."""
    values, known = arrays(layer)
    return torch.from_numpy(_maps(_share(_box(values, radius), _box(known, radius)), values.shape))


def gaussian_mean(layer: Layer, radius: int, sigma: float) -> Tensor:
    """Return the mean of the known cells around each known cell, weighted by a Gaussian of `sigma` cells."""
    values, known = arrays(layer)
    heights, datum = _from_datum(values, known)
    mean = _share(_gaussian(heights, radius, sigma), _gaussian(known, radius, sigma))
    return torch.from_numpy(_maps(mean, values.shape) + datum)


def deviation(layer: Layer, radius: int, least: float) -> Tensor:
    """Return the standard deviation of the known cells of the window around each known cell, at least `least`."""
    import cv2

    values, known = arrays(layer)
    heights, _ = _from_datum(values, known)
    number = _box(known, radius)
    mean = _share(_box(heights, radius), number)
    variance = np.multiply(mean, -mean, out=mean)
    variance += _share(_box(np.multiply(heights, heights, out=heights), radius), number)
    return torch.from_numpy(_maps(cv2.sqrt(np.maximum(variance, least**2, out=variance)), values.shape))


@functools.cache
def _square(radius: int) -> NDArray:
    return np.ones((2 * radius + 1, 2 * radius + 1), np.uint8)


def _share(total: NDArray, number: NDArray) -> NDArray:
    """Return the quotient, for which a limit of the divisor would take longer than all else: a known cell has none."""
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.divide(total, number, out=total)


def _from_datum(values: NDArray, known: NDArray) -> tuple[NDArray, NDArray]:
    """Return heights from each map's mean, 0 where unknown: sums of high ones would cost float32 its millimetres."""
    import cv2

    maps = zip(values, known.view(np.uint8), strict=True)
    means = [cv2.sumElems(heights)[0] / max(1, cv2.countNonZero(there)) for heights, there in maps]
    datum = np.array(means, np.float32)[:, None, None]
    return filled(values - datum, known, 0.0), datum


def _box(values: NDArray, radius: int) -> NDArray:
    """Return the sums of square windows, of floats or of a mask, as an image of maps apart."""
    import cv2

    width, border = (2 * radius + 1,) * 2, cv2.BORDER_CONSTANT
    return cv2.boxFilter(_numbers(values, radius), cv2.CV_32F, width, normalize=False, borderType=border)


def _gaussian(values: NDArray, radius: int, sigma: float) -> NDArray:
    """Return the weighted sums of windows, of floats or of a mask, as an image of maps apart."""
    import cv2

    weights = cv2.getGaussianKernel(2 * radius + 1, sigma, cv2.CV_32F)
    return cv2.sepFilter2D(_numbers(values, radius), cv2.CV_32F, weights, weights, borderType=cv2.BORDER_CONSTANT)


def _numbers(values: NDArray, radius: int) -> NDArray:
    """Return an image of maps apart that OpenCV adds up: floats, or the bytes of a mask, which take less time."""
    return _apart(values.view(np.uint8) if values.dtype == np.bool_ else values, radius, 0)


def lowest_of_holes(layer: Layer) -> Layer:
    """Return the layer with each hole at the lowest height of its border, known wherever a hole has one."""
    import cv2

    values, known = arrays(layer)
    heights = _apart(filled(values, known, BLANK), 1, BLANK)
    count, holes = cv2.connectedComponents(_apart((~known).view(np.uint8), 1, 0), connectivity=8)
    place = np.flatnonzero(holes)  # of known cells and the rows between maps, the number is 0
    number, lowest = holes.ravel()[place].astype(np.intp), np.full(count, BLANK, np.float32)
    np.minimum.at(lowest, number, cv2.erode(heights, _square(1)).ravel()[place])
    heights.ravel()[place] = lowest[number]
    spanned = _maps(heights, values.shape)
    return torch.from_numpy(spanned), torch.from_numpy(known | (spanned < BLANK))
