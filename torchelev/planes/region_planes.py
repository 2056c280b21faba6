"""Least-squares planes of regions, on the host."""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from torchelev.planes.sums import Surface

if TYPE_CHECKING:
    from jaxtyping import Float, Int
    from numpy import ndarray


class RegionPlanes(NamedTuple):
    """The planes z = z0 + g_x (x - x0) + g_y (y - y0) of K regions, each (K,) float64."""

    number: ndarray  #: of cells
    x0: ndarray  #: [m] of the centroid
    y0: ndarray  #: [m] of the centroid
    z0: ndarray  #: [m] of the centroid
    gradient_x: ndarray  #: dz/dx
    gradient_y: ndarray  #: dz/dy
    roughness: ndarray  #: [m] root mean square distance of the cells from the plane
    extent: ndarray  #: [m^2] mean squared distance of the cells from the centroid, in x and y

    def select(self, label: ndarray) -> RegionPlanes:
        """Return the planes of some labels."""
        return RegionPlanes(*(values[label] for values in self))

    def distance_weights(self) -> Float[ndarray, "K 4"]:
        """Return the weights of x, y, z and 1 in the signed distance [m] above each plane."""
        scale = 1 / np.sqrt(1 + self.gradient_x**2 + self.gradient_y**2)
        offset = self.z0 - self.gradient_x * self.x0 - self.gradient_y * self.y0
        return np.stack([-self.gradient_x, -self.gradient_y, np.ones_like(scale), -offset], 1) * scale[:, None]


def distances(surface: Surface, cell: Int[ndarray, "N"], weights: Float[ndarray, "N 4"]) -> Float[ndarray, "N"]:
    """Return the signed distance [m] of each cell above its plane, along the normal."""
    a, b, c, d = weights.T
    return a * surface.x[cell] + b * surface.y[cell] + c * surface.z[cell] + d


def fit_planes(sums: Float[ndarray, "12 K"], prior: tuple[ndarray, ndarray] | None, weight: float) -> RegionPlanes:
    """Fit a plane to the cells of each region by least squares, with a prior: (C + w I) g = c + w g_prior.

    C is the scatter of the cells' x and y, c their covariance with z. The prior counts as much as one window. It
    decides where a region is a few cells or a line, and vanishes beside a region of many windows.

    This is the host's twin of `plane_fit.fit_plane`, which fits one plane per cell on tensors: regions change in
    size and number in every round, and each round here takes less time than a device takes to answer.

    Args:
        sums: the regions' moments, see `region_moments`.
        prior: gradients (K,) along x and y; None: the mean gradients of the cells' windows.
        weight: w [m^2] of the prior, `Surface.window_moment`.
    """
    n, x, y, z, xx, xy, yy, xz, yz, zz, gx, gy = sums
    inverse = 1 / n.clip(min=1)
    x0, y0, z0 = x * inverse, y * inverse, z * inverse
    uu, uv, vv = xx - x * x0, xy - x * y0, yy - y * y0
    uh, vh, hh = xz - x * z0, yz - y * z0, zz - z * z0
    prior_x, prior_y = (gx * inverse, gy * inverse) if prior is None else prior
    a, b = uu + weight, vv + weight
    p, q = uh + weight * prior_x, vh + weight * prior_y
    det = a * b - uv * uv
    gx, gy = (b * p - uv * q) / det, (a * q - uv * p) / det
    square = hh - 2 * (gx * uh + gy * vh) + gx * gx * uu + 2 * gx * gy * uv + gy * gy * vv
    roughness = np.sqrt(square.clip(min=0) * inverse / (1 + gx * gx + gy * gy))
    return RegionPlanes(n, x0, y0, z0, gx, gy, roughness, (uu + vv) * inverse)
