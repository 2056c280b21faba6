"""The two layers of growing smoothness that TAMOLS plans with: where feet go, and what the base follows."""

from __future__ import annotations

from torchelev.filters.extrema import dilation
from torchelev.filters.registry import register
from torchelev.filters.smoothing import box, median
from torchelev.layers import Layer


@register
def smooth_ground(layer: Layer, *, resolution: float, median_radius: float = 0.05, blur_radius: float = 0.05) -> Layer:
    """Return the ground without artifacts and with round edges: `median`, then `box`.

    The first of the two smooth layers of TAMOLS, derived from the in-painted elevation (paper, figure of the layers in
    Sec. III-C; Sec. II-I.2 for the median against artifacts). Radii [m].
    The paper names the filters; their order and radii are chosen here.
    """
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

    The second, smoother layer of TAMOLS: gaps up to twice the dilation's radius are bridged, steps become ramps. With
    `blur_radius` up to `dilation_radius` it lies nowhere below the median. It is to be read from in-painted elevation,
    as unknown cells stay unknown. Radii [m]. The paper names the filters; their order and radii are chosen here.
    """
    artifact_free = median(layer, resolution=resolution, radius=median_radius)
    bridged = dilation(artifact_free, resolution=resolution, radius=dilation_radius)
    return box(bridged, resolution=resolution, radius=blur_radius)
