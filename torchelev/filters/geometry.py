"""Local geometry: what the cells around a cell say of its slope, steps, roughness and curvature.

Every window is a square of (2 r + 1)^2 cells, r being the radius in whole cells: what it spans depends on the
resolution by a cell. On hills of 1.6 m, with a radius of 16 cm, cells of 2 and 8 cm agree to 3 % of the largest value
for slopes, steps and curvature, to 11 % for standard deviations and 24 % for roughness, which grow with the window.

Heights are counted from the map's mean, so that altitude costs no precision. In float32 a slope is good to 1e-5 rad, a
roughness or standard deviation to 1 / 2000 of the height over that mean.
"""

from __future__ import annotations

import functools
import math
from typing import TYPE_CHECKING

import torch
from torch import Tensor

from torchelev.errors import require
from torchelev.filters import opencv
from torchelev.filters.extrema import highest_known, lowest_known
from torchelev.filters.registry import radius_cells, register
from torchelev.layers import Layer, normal_component
from torchelev.ops.storage import as_bytes
from torchelev.ops.windows import window_moments
from torchelev.stages.surface import Plane, fit_plane, known_ground

if TYPE_CHECKING:
    from jaxtyping import Float

TINY = 1e-12  # below it a root counts as zero, where its derivative would be infinite


def less(value, x, y):
    return value - x * y


def root(square: Tensor) -> Tensor:
    """Return the square root, at least 1e-6, with finite derivatives."""
    return square.clamp(min=TINY).sqrt()


def plane_around(layer: Layer, resolution: float, radius: float) -> Plane:
    """Fit the least-squares plane of the known cells within `radius` [m] of each cell; `spans` is of known cells."""
    cells = radius_cells(radius, resolution)
    plane = fit_plane(known_ground(*layer, cells), cells, resolution)
    return plane._replace(spans=plane.spans & layer[1])


@register
def slope(layer: Layer, *, resolution: float, radius: float = 0.1) -> Layer:
    """Return the inclination [rad] of the plane z = c + g_x x + g_y y around each cell: atan(sqrt(g_x^2 + g_y^2)).

    At least 1e-6. Unknown where the known cells of the window do not span a plane: see `surface.spans_plane`.
    """
    plane = plane_around(layer, resolution, radius)
    return torch.atan(root(plane.gradient_x.square() + plane.gradient_y.square())), plane.spans


def _normal(layer: Layer, resolution: float, radius: float, axis: int) -> Layer:
    plane = plane_around(layer, resolution, radius)
    return normal_component(plane.gradient_x, plane.gradient_y, axis), plane.spans


@register
def normal_x(layer: Layer, *, resolution: float, radius: float = 0.1) -> Layer:
    """Return the x component of the unit normal n = (-g_x, -g_y, 1) / sqrt(1 + g_x^2 + g_y^2) of `slope`'s plane."""
    return _normal(layer, resolution, radius, 0)


@register
def normal_y(layer: Layer, *, resolution: float, radius: float = 0.1) -> Layer:
    """Return the y component of the unit normal."""
    return _normal(layer, resolution, radius, 1)


@register
def normal_z(layer: Layer, *, resolution: float, radius: float = 0.1) -> Layer:
    """Return the z component of the unit normal, the cosine of the slope."""
    return _normal(layer, resolution, radius, 2)


@register
def roughness(layer: Layer, *, resolution: float, radius: float = 0.1) -> Layer:
    """Return the standard deviation [m] of the heights around the plane around each cell.

    sqrt(mean (z - c - g_x x - g_y y)^2), the distance in z, over all known cells of the window. Unknown where these do
    not span a plane.
    """
    plane = plane_around(layer, resolution, radius)
    return root(plane.residual), plane.spans


@register
def standard_deviation(layer: Layer, *, resolution: float, radius: float = 0.1) -> Layer:
    """Return the standard deviation [m] around the window's mean, sqrt(mean z^2 - (mean z)^2): slopes count too."""
    cells = radius_cells(radius, resolution)
    if opencv.serves(layer[0]):
        return opencv.deviation(layer, cells, math.sqrt(TINY)), layer[1]
    known, height, _ = known_ground(*layer, cells)
    (sums,) = window_moments([(torch.stack([known, height, height.square()]), 0)], cells, cells)
    number, total, squares = sums.unbind(0)
    share = 1 / number.clamp(min=1)
    mean = total * share
    return root(less(squares * share, mean, mean)), layer[1]


@register
def step_height(layer: Layer, *, resolution: float, radius: float = 0.1, less_slope: bool = False) -> Layer:
    """Return the height [m] of the highest known cell of the window over the lowest.

    The first stage of the step filter of traversability_estimation (Wermelinger et al. 2016), on a square window; a
    dilation of it is the second stage, less that one's count of critical cells. A slope has height too:
    `less_slope` takes off what the window's own plane explains, 2 radius (|g_x| + |g_y|), and returns at least 0.
    """
    values, known = layer
    cells = radius_cells(radius, resolution)
    height = highest_known(values, known, cells) - lowest_known(values, known, cells)
    if less_slope:
        plane = plane_around(layer, resolution, radius)
        explained = 2 * cells * resolution * (plane.gradient_x.abs() + plane.gradient_y.abs())
        return (height - explained).clamp(min=0), plane.spans
    return height, known


def _power_sums(values: Tensor, rim: int, dim: int, order: int) -> list[Tensor]:
    """Sum (k / rim)^p * values over k = -rim .. rim along one dimension that has a rim, for p = 0 .. order."""
    size = values.shape[dim] - 2 * rim
    middle, steps = values.narrow(dim, rim, size), range(1, rim + 1)
    sides = [(values.narrow(dim, rim - k, size), values.narrow(dim, rim + k, size)) for k in steps]
    even = [before + after for before, after in sides]
    odd = [after - before for before, after in sides] if order else []
    sums = [functools.reduce(torch.add, even, middle)]
    for power in range(1, order + 1):
        terms = odd if power % 2 else even
        total = terms[-1]  # k = rim weighs 1
        for k, term in zip(steps, terms[:-1], strict=False):
            total = torch.add(total, term, alpha=(k / rim) ** power)
        sums.append(total)
    return sums


def _moments(values: Tensor, rim: int, order: int) -> dict[tuple[int, int], Tensor]:
    """Sum (u / rim)^a (v / rim)^b * values over each window, for all a + b <= order; u counts along H, v along W."""
    lines = _power_sums(values, rim, -1, order)
    return {(a, b): m for b, line in enumerate(lines) for a, m in enumerate(_power_sums(line, rim, -2, order - b))}


def _along(uu: Tensor, vv: Tensor, uv: Tensor, us: Tensor, vs: Tensor) -> tuple[Tensor, Tensor]:
    """Solve [uu uv; uv vv] (p, q) = (us, vs); along the line, if the cells lie on one."""
    det, spread = less(uu * vv, uv, uv), (uu + vv).clamp(min=1e-6)
    # By a weight: on a CPU `torch.where` takes ten times as long.
    regular = as_bytes(det > 1e-6).to(det.dtype)
    inverse, along = regular / (det * regular + (1 - regular)), (1 - regular) / spread
    p = less(vv * us, uv, vs) * inverse + us * along
    q = less(uu * vs, uv, us) * inverse + vs * along
    return p, q


@register
def curvature(layer: Layer, *, resolution: float, radius: float = 0.15) -> Layer:
    """Return how the ground bends [1/m]: positive in hollows, negative on bumps, 1 / r in the bottom of a bowl.

    The kappa of the least-squares fit z = c + g_x x + g_y y + kappa (x^2 + y^2) / 2 to the window's known cells. Where
    all are known that is half the Laplacian of the best quadratic, the mean curvature of level ground, and exact on
    every quadratic; where some are unknown, exact on paraboloids of revolution. Unknown where the known cells do not
    tell, as where they lie in a corner of less than a quarter of the window.
    """
    values, known = layer
    r = radius_cells(radius, resolution)
    ground = known_ground(values, known, r)
    n, z = _moments(ground.known, r, 4), _moments(ground.height, r, 2)
    share = 1 / n[0, 0].clamp(min=1)
    mu, mv, mz = n[1, 0] * share, n[0, 1] * share, z[0, 0] * share
    # s = u^2 + v^2; a pair of letters is the covariance of both over the window.
    ms = (n[2, 0] + n[0, 2]) * share
    uu, vv, uv = (less(n[k] * share, a, b) for k, a, b in (((2, 0), mu, mu), ((0, 2), mv, mv), ((1, 1), mu, mv)))
    us, vs = less((n[3, 0] + n[1, 2]) * share, mu, ms), less((n[2, 1] + n[0, 3]) * share, mv, ms)
    ss = less((n[4, 0] + 2 * n[2, 2] + n[0, 4]) * share, ms, ms)
    uz, vz = less(z[1, 0] * share, mu, mz), less(z[0, 1] * share, mv, mz)
    sz = less((z[2, 0] + z[0, 2]) * share, ms, mz)
    # What a plane explains of s is taken off s; the rest, against z, gives the coefficient of s.
    p, q = _along(uu, vv, uv, us, vs)
    spread = less(less(ss, p, us), q, vs)
    tells = as_bytes(spread > 0.004).to(spread.dtype)  # of a full window 0.18 to 0.45
    bend = less(less(sz, p, uz), q, vz) * tells / (spread * tells + (1 - tells))
    return 2 * bend / (r * resolution) ** 2, known & (tells > 0)


def require_critical(**values: float) -> None:
    """Refuse critical values that are not positive."""
    for name, value in values.items():
        require(value > 0 and math.isfinite(value), name, "must be positive and finite", value, "see its default")


def weigh(*parts: tuple[Tensor, float]) -> Float[Tensor, "B H W"]:
    """Return the weighted mean of parts (B, H, W), 1 at their best and 0 at their critical value; 0 if one is below 0.

    Raises ValueError for weights below 0, and for weights that are all 0.
    """
    weights = [weight for _, weight in parts]
    good = all(0 <= weight < math.inf for weight in weights) and sum(weights) > 0
    require(good, "weights", "must be at least 0, and not all 0", weights, "give shares, such as 1 each")
    mean = sum((part * (weight / sum(weights)) for part, weight in parts), start=torch.zeros_like(parts[0][0]))
    worst = functools.reduce(torch.minimum, (part for part, _ in parts))
    return mean * (worst >= 0)


@register
def traversability_three_part(
    slope: Layer,
    step_height: Layer,
    roughness: Layer,
    *,
    critical_slope: float = 0.7,
    critical_step: float = 0.2,
    critical_roughness: float = 0.05,
    weight_slope: float = 1.0,
    weight_step: float = 1.0,
    weight_roughness: float = 1.0,
) -> Layer:
    """Return the traversability of elevation mapping on CPUs, 0 to 1, the better (Wermelinger et al. 2016).

    t = w_s (1 - s / s_c) + w_h (1 - h / h_c) + w_r (1 - r / r_c) of slope s [rad], step height h [m] and roughness r
    [m], the weights being divided by their sum; 0 where one exceeds its critical value. Known where all three are.
    """
    require_critical(critical_slope=critical_slope, critical_step=critical_step, critical_roughness=critical_roughness)
    (s, s_known), (h, h_known), (r, r_known) = slope, step_height, roughness
    rated = weigh(
        (1 - s / critical_slope, weight_slope),
        (1 - h / critical_step, weight_step),
        (1 - r / critical_roughness, weight_roughness),
    )
    return rated, s_known & h_known & r_known
