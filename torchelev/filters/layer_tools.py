"""What every filter needs: checks of layers, conversion from and to NaN, and window sizes in cells."""

from __future__ import annotations

from typing import TYPE_CHECKING, NoReturn

import torch
from torch import Tensor

from torchelev.errors import message, require, require_positive
from torchelev.filters import opencv
from torchelev.layers import Layer
from torchelev.plane_fit import MAX_RADIUS

if TYPE_CHECKING:
    from jaxtyping import Bool, Float


def as_layer(values: Float[Tensor, "B H W"]) -> Layer:
    """Return values as a layer; NaN and infinite values are unknown."""
    known = torch.isfinite(values)
    return torch.where(known, values, 0.0), known


def as_nan(layer: Layer) -> Float[Tensor, "B H W"]:
    """Return a layer's values, NaN where unknown."""
    values, known = layer
    return torch.where(known, values, torch.nan)


def known_weight(known: Bool[Tensor, "B H W"], dtype: torch.dtype) -> Float[Tensor, "B H W"]:
    """Return 1 where known and 0 elsewhere. On a CPU, conversion by way of bytes takes a fifth of the time."""
    return known.view(torch.uint8).to(dtype)


def radius_cells(radius: float, resolution: float, name: str = "radius", reach: float = 1.0) -> int:
    """Return the radius of a window in cells, rounded, from 1 to `MAX_RADIUS`.

    Args:
        radius: the setting [m].
        resolution: [m] of a cell.
        name: of the setting.
        reach: how many times as far as the setting the window reaches.
    """
    require_positive(**{name: radius, "resolution": resolution})
    cells = reach * radius / resolution
    rule = f"must be at most {MAX_RADIUS * resolution / reach:g} m, a window of {MAX_RADIUS} cells"
    require(cells <= MAX_RADIUS, name, rule, radius, "give a smaller one")
    return max(1, round(cells))


def require_radii(resolution: float, **radii: float) -> None:
    """Refuse radii [m] by their names, as `radius_cells` does."""
    for name, radius in radii.items():
        radius_cells(radius, resolution, name)


def zero_unknown(layer: Layer) -> Layer:
    """Set values to 0 where unknown, and treat values that are not finite as unknown; return at least float32."""
    values, known = layer
    if opencv.is_usable(values):
        return opencv.zero_unknown(values, known)
    values = values.to(torch.promote_types(values.dtype, torch.float32))
    known = known & values.isfinite()
    # A product, as `torch.where` takes five times as long on a CPU.
    return values.nan_to_num(0.0, 0.0, 0.0) * known_weight(known, values.dtype), known


def check_layers(name: str, layers: tuple[Layer, ...], shape: tuple[int, ...] | None = None) -> None:
    """Refuse layers that are not pairs of (B, H, W) tensors, or that differ in shape from each other or from `shape`.

    Raises:
        TypeError: if a layer is not a pair of tensors.
        ValueError: if shapes or dtypes do not fit.
    """
    # Error texts are composed only when needed: composing them takes as long as all the checks.
    for number, layer in enumerate(layers):
        is_pair = isinstance(layer, tuple) and len(layer) == 2 and all([isinstance(part, Tensor) for part in layer])
        if not is_pair or not _fits(*layer):
            _refuse(f"{name}, layer {number}", layer, is_pair)
    shapes = [values.shape for values, _ in layers] + ([] if shape is None else [shape])
    if len(set(shapes)) != 1:
        actual = [tuple(shape) for shape in shapes]
        raise ValueError(message(name, "expected one or more layers of one shape", actual, "read them from one map"))


def _fits(values: Tensor, known: Tensor) -> bool:
    has_shape = values.ndim == 3 and values.shape == known.shape
    return has_shape and values.is_floating_point() and known.dtype == torch.bool


def _refuse(argument: str, layer: Layer, is_pair: bool) -> NoReturn:
    hint = "make one from values with NaN by filters.as_layer"
    require(is_pair, argument, "must be a layer (values, known)", type(layer).__name__, hint, TypeError)
    values, known = layer
    require(known.dtype == torch.bool, argument, "known must be bool", known.dtype, hint)
    actual = f"{tuple(values.shape)} {values.dtype} and {tuple(known.shape)} {known.dtype}"
    raise ValueError(message(argument, "expected values (B, H, W) of floats and known (B, H, W)", actual, hint))
