"""Curvature of the ground around each cell."""

from __future__ import annotations

from torchelev.filters.layer_tools import radius_cells
from torchelev.filters.registry import register
from torchelev.layers import Layer
from torchelev.ops.masks import where_finite
from torchelev.ops.windows import window_moments
from torchelev.plane_fit import known_ground, solve_gradient

# In units of the window's radius.
_MIN_TRACE = 1e-6  # below it there is a single cell
_MIN_DETERMINANT = 1e-6  # below it the cells lie on a line
_MIN_SPREAD = 0.004  # variance of u^2 + v^2 that no plane explains; 0.18 to 0.45 for a full window


@register
def curvature(layer: Layer, *, resolution: float, radius: float = 0.15) -> Layer:
    """Return the curvature [1/m] of the ground: positive in hollows, negative on bumps, 1 / r at the bottom of a bowl.

    kappa of the least-squares fit z = c + g_x x + g_y y + kappa (x^2 + y^2) / 2 to the window's known cells. In a fully
    known window it is half the Laplacian of the best quadratic, the mean curvature of level ground, and exact on every
    quadratic; in other windows it is exact on paraboloids of revolution. Cells of 2 cm and of 8 cm agree to 3 %.

    Unknown where the known cells do not determine kappa, for example where they lie in a corner of less than a quarter
    of the window.

    Args:
        layer: heights [m] and mask (B, H, W).
        resolution: [m] of a cell.
        radius: [m] half the window's side, rounded to cells, at least one.

    Raises:
        ValueError: if the radius is not positive.
    """
    values, known = layer
    r = radius_cells(radius, resolution)
    ground = known_ground(values, known, r)
    moments = window_moments([(ground.known, 4), (ground.height, 2)], r, r)
    n, n_v, n_vv, n_vvv, n_vvvv, n_u, n_uv, n_uvv, _, n_uu, n_uuv, n_uuvv, n_uuu, _, n_uuuu = moments[:15]
    h, h_v, h_vv, h_u, _, h_uu = moments[15:]
    # s = u^2 + v^2; a pair of letters is the covariance of both over the window.
    w = 1 / n.clamp(min=1)
    mu, mv, mz, ms = n_u * w, n_v * w, h * w, (n_uu + n_vv) * w
    uu, vv, uv = n_uu * w - mu * mu, n_vv * w - mv * mv, n_uv * w - mu * mv
    us, vs = (n_uuu + n_uvv) * w - mu * ms, (n_uuv + n_vvv) * w - mv * ms
    ss = (n_uuuu + 2 * n_uuvv + n_vvvv) * w - ms * ms
    uz, vz, sz = h_u * w - mu * mz, h_v * w - mv * mz, (h_uu + h_vv) * w - ms * mz
    # Subtract from s the plane that fits it best; kappa follows from the covariance of the rest with z.
    p, q = solve_gradient(uu, uv, vv, us, vs, _MIN_DETERMINANT * r**4, _MIN_TRACE * r**2)
    spread = ss - p * us - q * vs
    is_determined = spread > _MIN_SPREAD * r**4
    bend = where_finite(is_determined, sz - p * uz - q * vz, 0.0) / where_finite(is_determined, spread, 1.0)
    return 2 * bend / resolution**2, known & is_determined
