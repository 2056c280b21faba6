"""Ratings of ground from several layers: three-part traversability and foothold score."""

from __future__ import annotations

import functools
import math
from typing import TYPE_CHECKING

import torch
from torch import Tensor

from torchelev.errors import require
from torchelev.filters.registry import register
from torchelev.layers import Layer

if TYPE_CHECKING:
    from jaxtyping import Float


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
    """Return the traversability of Wermelinger et al. 2016, from 0 (worst) to 1 (best).

    t = w_s (1 - s / s_c) + w_h (1 - h / h_c) + w_r (1 - r / r_c), with the weights divided by their sum; 0 where a part
    exceeds its critical value. Known where all three layers are.

    Args:
        slope: s [rad].
        step_height: h [m].
        roughness: r [m].
        critical_slope: s_c [rad].
        critical_step: h_c [m].
        critical_roughness: r_c [m].
        weight_slope: w_s.
        weight_step: w_h.
        weight_roughness: w_r.

    Raises:
        ValueError: if a critical value is not positive, a weight is negative, or all weights are 0.
    """
    _require_critical(critical_slope=critical_slope, critical_step=critical_step, critical_roughness=critical_roughness)
    (s, s_known), (h, h_known), (r, r_known) = slope, step_height, roughness
    rating = _weighted_mean(
        (1 - s / critical_slope, weight_slope),
        (1 - h / critical_step, weight_step),
        (1 - r / critical_roughness, weight_roughness),
    )
    return rating, s_known & h_known & r_known


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
    """Return how good each cell is as a foothold: 1 on level ground away from edges, 0 where a foot must not stand.

    f = w_s (1 - s / s_c) + w_d (1 - d / d_c) + w_e min(1, e / e_s), with the weights divided by their sum; 0 where
    slope or deviation exceeds its critical value, and where e < 0, within an obstacle. Known where all three layers
    are.

    A sum of geometric features, as in the planners that the paper names (Sec. I): slope and standard deviation as in
    Jenelten et al. 2020 (paper, Sec. III), and the distance to edges, from which planners keep feet away by a margin
    (Grandia et al. 2022). The weights and this sum are this library's own.

    Args:
        slope: s [rad], from the filter `slope`, or acos(n_z) of a layer of normals.
        standard_deviation: d [m], from the filter `standard_deviation`, or `roughness` so that a slope counts once.
        edge_distance: e [m], from the filter `signed_distance`.
        critical_slope: s_c [rad].
        critical_deviation: d_c [m].
        safe_distance: e_s [m], from which on an edge no longer matters.
        weight_slope: w_s.
        weight_deviation: w_d.
        weight_distance: w_e.

    Raises:
        ValueError: if a critical value or the distance is not positive, a weight is negative, or all weights are 0.
    """
    _require_critical(critical_slope=critical_slope, critical_deviation=critical_deviation, safe_distance=safe_distance)
    (s, s_known), (d, d_known), (e, e_known) = slope, standard_deviation, edge_distance
    score = _weighted_mean(
        (1 - s / critical_slope, weight_slope),
        (1 - d / critical_deviation, weight_deviation),
        ((e / safe_distance).clamp(max=1), weight_distance),
    )
    return score, s_known & d_known & e_known


def _require_critical(**values: float) -> None:
    """Refuse critical values that are not positive and finite."""
    for name, value in values.items():
        require(value > 0 and math.isfinite(value), name, "must be positive and finite", value, "see its default")


def _weighted_mean(*parts: tuple[Tensor, float]) -> Float[Tensor, "B H W"]:
    """Return the weighted mean of parts (B, H, W), each 1 at best and 0 at its critical value; 0 if one is negative."""
    weights = [weight for _, weight in parts]
    is_valid = all(0 <= weight < math.inf for weight in weights) and sum(weights) > 0
    require(is_valid, "weights", "must be at least 0, and not all 0", weights, "give shares, such as 1 each")
    mean = sum((part * (weight / sum(weights)) for part, weight in parts), start=torch.zeros_like(parts[0][0]))
    worst = functools.reduce(torch.minimum, (part for part, _ in parts))
    return mean * (worst >= 0)
