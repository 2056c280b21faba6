"""Local planes: the slope of the ground at every known cell."""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

import torch
from torch import Tensor

from torchelev.ops.windows import padded, window_moments

if TYPE_CHECKING:
    from jaxtyping import Bool, Float

MAX_RADIUS = 1000  # [cells] of a window that a config may ask for: far beyond any robot's, and memory ends
MIN_DET = 1e-4  # [cells^4] of the covariance of places that spread in two directions
MIN_TRACE = 1e-2  # [cells^2] of the covariance of places that spread in one


class Ground(NamedTuple):
    """The known heights, with a rim around the map that windows may reach into; nothing is known there."""

    known: Float[Tensor, "B H+2*rim W+2*rim"]  #: 1 or 0
    height: Float[Tensor, "B H+2*rim W+2*rim"]  #: [m] from the map's mean; 0 where unknown
    rim: int  #: [cells]


def known_ground(elevation: Float[Tensor, "B H W"], validity: Bool[Tensor, "B H W"], rim: int) -> Ground:
    """Put a rim around the known heights, once for all the windows."""
    heights = torch.where(validity, elevation, 0.0)  # unknown ones may be NaN
    number = validity.to(elevation.dtype).sum((1, 2), keepdim=True).clamp(min=1)
    # Heights from the map's mean: squares of absolute heights would cost float32 its millimetres.
    datum = (heights.sum((1, 2), keepdim=True) / number).detach()
    # One layer holds both height and validity, which is less to store and to read than two.
    nowhere = 0.5 * torch.finfo(heights.dtype).max  # differences to it are finite
    layer = padded(torch.where(validity, heights - datum, nowhere), rim, nowhere)
    known = (layer < nowhere).to(layer.dtype)
    return Ground(known, layer * known, rim)


class Plane(NamedTuple):
    """Least-squares plane through the known cells of a window, for every cell."""

    spans: Bool[Tensor, "B H W"]  #: the known cells span a plane; elsewhere gradient and residual are meaningless

    gradient_x: Float[Tensor, "B H W"]  #: dz/dx
    gradient_y: Float[Tensor, "B H W"]  #: dz/dy
    residual: Float[Tensor, "B H W"]  #: [m^2] mean squared distance in z


def fit_plane(ground: Ground, radius: int, resolution: float) -> Plane:
    """Fit z = c + g_x x + g_y y by least squares to the known cells within `radius` cells of each cell.

    Only known cells enter, so a plane comes out right at the border of the known area. Cells that do not span a plane
    (`spans_plane`) have some finite gradient.
    """
    z = ground.height
    moments = window_moments([(ground.known, 2), (z, 1), (z.square(), 0)], ground.rim, radius)
    n, n_v, n_vv, n_u, n_uv, n_uu, s_z, s_vz, s_uz, s_zz = moments
    w = 1 / n.clamp(min=1)
    mu, mv, mz = n_u * w, n_v * w, s_z * w
    uu, uv, vv = n_uu * w - mu * mu, n_uv * w - mu * mv, n_vv * w - mv * mv
    uz, vz, zz = s_uz * w - mu * mz, s_vz * w - mv * mz, s_zz * w - mz * mz
    gu, gv = solve_gradient(uu, uv, vv, uz, vz)
    residual = (zz - gu * uz - gv * vz).clamp(min=0)
    return Plane(spans_plane(uu, uv, vv, radius), gu / resolution, gv / resolution, residual)


def solve_gradient(
    uu: Tensor, uv: Tensor, vv: Tensor, uz: Tensor, vz: Tensor, min_det: float = MIN_DET, min_trace: float = MIN_TRACE
) -> tuple[Tensor, Tensor]:
    """Solve [uu uv; uv vv] (g_u, g_v) = (uz, vz), given the covariances of cells' places and heights.

    Cells on a line, whose determinant is below `min_det`, have their gradient along it.
    """
    det, trace = uu * vv - uv * uv, uu + vv
    is_regular = det > min_det
    # Both are far above these limits, or zero but for rounding.
    safe_det, safe_trace = det.clamp(min=min_det), trace.clamp(min=min_trace)
    gu = torch.where(is_regular, (vv * uz - uv * vz) / safe_det, uz / safe_trace)
    gv = torch.where(is_regular, (uu * vz - uv * uz) / safe_det, vz / safe_trace)
    return gu, gv


def spans_plane(uu: Tensor, uv: Tensor, vv: Tensor, radius: int) -> Bool[Tensor, "B H W"]:
    """Return where the known cells of a window spread in two directions, by the covariance of their places [cells^2].

    Its smaller eigenvalue, the variance across the line that fits them best, must reach `min_spread`: then
    C - min_spread I has no negative eigenvalue.
    """
    u, v = uu - min_spread(radius), vv - min_spread(radius)
    return (u >= 0) & (v >= 0) & (u * v >= uv * uv)


def min_spread(radius: int) -> float:
    """Return the variance [cells^2] across their line from which known cells span a plane.

    At least that of two full rows of cells, 1/4: the cells that a line of points passes through stay below it, and
    their heights determine the slope along the line alone. And 0.4 times the standard deviation of a full window,
    r (r + 1) / 3 in variance: a narrower band can be one line of points and its noise, whose slope is the ray's.
    """
    rounding = 1e-3
    return max(0.25, 0.4**2 * radius * (radius + 1) / 3) - rounding


class Normals(NamedTuple):
    """The unit normal n = (-g_x, -g_y, 1) / sqrt(1 + g_x^2 + g_y^2) of each cell is made when it is read."""

    gradient_x: Float[Tensor, "B H W"]  #: dz/dx
    gradient_y: Float[Tensor, "B H W"]  #: dz/dy
    has_normal: Bool[Tensor, "B H W"]  #: known cells whose neighbours span a plane; elsewhere the gradient is 0


def normals(ground: Ground, validity: Bool[Tensor, "B H W"], radius: int, resolution: float) -> Normals:
    """Return the gradient of every known cell whose neighbours span a plane (paper, Sec. II-A)."""
    plane = fit_plane(ground, radius, resolution)
    has_normal = validity & plane.spans
    return Normals(plane.gradient_x * has_normal, plane.gradient_y * has_normal, has_normal)
