"""Where a foot can stand: a score from what the ground is like around a cell."""

from __future__ import annotations

from torchelev.filters.geometry import require_critical, weigh
from torchelev.filters.registry import register
from torchelev.layers import Layer


@register
def foothold_score(
    slope: Layer,
    standard_deviation: Layer,
    edge_distance: Layer,
    *,
    critical_slope: float = 0.6,
    critical_deviation: float = 0.04,
    safe_distance: float = 0.08,
    weight_slope: float = 1.0,
    weight_deviation: float = 1.0,
    weight_distance: float = 1.0,
) -> Layer:
    """Return how good a foothold each cell is: 0 where a foot must not stand, 1 on level ground away from edges.

    f = w_s (1 - s / s_c) + w_d (1 - d / d_c) + w_e min(1, e / e_s), the weights being divided by their sum, of
    - slope s [rad] (filter `slope`; from a layer of normals, acos(n_z)), critical at s_c = `critical_slope`,
    - standard deviation d [m] (`standard_deviation`, or `roughness` to count a slope once), critical at d_c,
    - edge distance e [m] (`signed_distance`), best from e_s = `safe_distance` on.
    0 where slope or deviation exceed their critical values, and where e < 0: within an obstacle.

    A sum of geometric features as in the planners that the paper names (Sec. I); of the terrain's normal and standard
    deviation as in Jenelten et al. 2020 (paper, Sec. III), and of the distance to edges, from which planners keep feet
    away by a margin (Grandia et al. 2022). The weights and this sum are ours. Known where all three layers are.
    """
    require_critical(critical_slope=critical_slope, critical_deviation=critical_deviation, safe_distance=safe_distance)
    (s, s_known), (d, d_known), (e, e_known) = slope, standard_deviation, edge_distance
    score = weigh(
        (1 - s / critical_slope, weight_slope),
        (1 - d / critical_deviation, weight_deviation),
        ((e / safe_distance).clamp(max=1), weight_distance),
    )
    return score, s_known & d_known & e_known
