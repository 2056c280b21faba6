"""The two smooth layers that TAMOLS plans with: the ground for the feet, and a floor for the base."""

from __future__ import annotations

from torchelev.filters.extrema import dilation
from torchelev.filters.layer_tools import require_radii
from torchelev.filters.registry import register
from torchelev.filters.smoothing import box, median
from torchelev.layers import Layer


@register
def smooth_ground(layer: Layer, *, resolution: float, median_radius: float = 0.05, blur_radius: float = 0.05) -> Layer:
    """Return the ground without artifacts and with rounded edges: `median`, then `box`.

    The first smooth layer of TAMOLS, derived from the in-painted elevation (paper, figure of the layers in Sec. III-C;
    Sec. II-I.2 for the median against artifacts). The paper names the filters; their order and radii are chosen here.

    Args:
        layer: heights [m] and mask (B, H, W), in-painted.
        resolution: [m] of a cell.
        median_radius: [m] of the median's window.
        blur_radius: [m] of the box's window.

    Raises:
        ValueError: if a radius is not positive.
    """
    require_radii(resolution, median_radius=median_radius, blur_radius=blur_radius)
    artifact_free = median(layer, resolution=resolution, radius=median_radius)
    return box(artifact_free, resolution=resolution, radius=blur_radius)


@register
def virtual_floor(
    layer: Layer,
    *,
    resolution: float,
    median_radius: float = 0.05,
    dilation_radius: float = 0.2,
    blur_radius: float = 0.2,
) -> Layer:
    """Return the floor that the base's pose refers to: `median`, `dilation`, `box` (paper, Sec. III-D.2).

    The second, smoother layer of TAMOLS. Gaps up to twice the dilation's radius are bridged, and steps become ramps.
    With `blur_radius` up to `dilation_radius` it lies nowhere below the median. The paper names the filters; their
    order and radii are chosen here.

    Args:
        layer: heights [m] and mask (B, H, W), in-painted: unknown cells stay unknown.
        resolution: [m] of a cell.
        median_radius: [m] of the median's window.
        dilation_radius: [m] of the dilation's window.
        blur_radius: [m] of the box's window.

    Raises:
        ValueError: if a radius is not positive.
    """
    require_radii(resolution, median_radius=median_radius, dilation_radius=dilation_radius, blur_radius=blur_radius)
    artifact_free = median(layer, resolution=resolution, radius=median_radius)
    bridged = dilation(artifact_free, resolution=resolution, radius=dilation_radius)
    return box(bridged, resolution=resolution, radius=blur_radius)
