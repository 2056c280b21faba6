"""Errors of clouds, given the random numbers: wrong ranges, noise, quantisation and losses, in this order."""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

import torch
from torch import Tensor

from torchelev.sim.errors import cloud_kernel
from torchelev.sim.errors.draws import DomainRandomization
from torchelev.sim.errors.range_errors import (
    add_artefacts,
    add_flying_points,
    find_range_across_edge,
    quantise,
    quantise_disparity,
)

if TYPE_CHECKING:
    from jaxtyping import Float


class Draws(NamedTuple):
    """Random numbers of B clouds: u uniform from 0 to 1, n standard normal. None: that error is not used."""

    flying: Float[Tensor, "B M"] | None  #: u
    artefact: Float[Tensor, "B M"] | None  #: u
    range_noise: Float[Tensor, "B M"] | None  #: n
    outlier: Float[Tensor, "B M"] | None  #: u
    point_noise: Float[Tensor, "B M 3"] | None  #: n
    missed: Float[Tensor, "B 1"] | None  #: u
    dropped: Float[Tensor, "B M"] | None  #: u


def draw(errors: DomainRandomization, M: int) -> Draws:
    """Draw the random numbers of clouds of M points."""
    B, uses = errors.num_envs, errors.uses
    has_noise, has_losses = uses("point_noise", "outlier_noise"), uses("dropout", "missed_frames")
    return Draws(
        flying=errors.uniform(B, M) if uses("flying") else None,
        artefact=errors.uniform(B, M) if uses("too_short", "too_long") else None,
        range_noise=errors.normal(B, M) if uses("range_constant", "range_quadratic") else None,
        outlier=errors.uniform(B, M) if has_noise and uses("outliers") else None,
        point_noise=errors.normal(B, M, 3) if has_noise else None,
        missed=errors.uniform(B, 1) if has_losses else None,
        dropped=errors.uniform(B, M) if has_losses else None,
    )


def disturb(
    errors: DomainRandomization, points: Float[Tensor, "B M 3"], draws: Draws, image_shape: tuple[int, int]
) -> Float[Tensor, "B M 3"]:
    """Return clouds with errors, fresh tensors; see `SensorErrorConfig`.

    Args:
        errors: The settings of each environment.
        points: Ideal points [m] in the sensor frame, x forward; NaN where there is no return.
        draws: The random numbers.
        image_shape: (h, w) of the points, row by row.
    """
    changes_ranges = _changes_ranges(errors, draws)
    disturbed = cloud_kernel.disturb(points, errors.values, errors.names, draws, image_shape, changes_ranges)
    return disturb_in_torch(errors, points, draws, image_shape) if disturbed is None else disturbed


def disturb_in_torch(
    errors: DomainRandomization, points: Float[Tensor, "B M 3"], draws: Draws, image_shape: tuple[int, int]
) -> Float[Tensor, "B M 3"]:
    """Do the same by tensors: this is the definition."""
    points = _disturb_ranges(errors, points, draws, image_shape) if _changes_ranges(errors, draws) else points.clone()
    if draws.point_noise is not None:
        points = points + _point_sigma(errors, draws)[..., None] * draws.point_noise
    if errors.uses("disparity_step"):
        points = quantise_disparity(points, errors.value("disparity_step", 2))
    return _drop(errors, points, draws)


def _changes_ranges(errors: DomainRandomization, draws: Draws) -> bool:
    """Return whether any error moves points along their rays."""
    return errors.uses("range_step") or any(u is not None for u in (draws.flying, draws.artefact, draws.range_noise))


def _disturb_ranges(errors: DomainRandomization, points: Tensor, draws: Draws, shape: tuple[int, int]) -> Tensor:
    """Change the ranges of the points, not their directions."""
    measured = d = torch.linalg.vector_norm(points, dim=-1)
    if draws.flying is not None:
        fraction, step = errors.value("flying", 2), errors.value("flying_step", 2)
        measured = add_flying_points(d, find_range_across_edge(d, shape), draws.flying, fraction, step)
    if draws.artefact is not None:
        short, long = errors.value("too_short", 2), errors.value("too_long", 2)
        measured = add_artefacts(measured, draws.artefact, short, long)
    if draws.range_noise is not None:
        sigma = errors.value("range_constant", 2) + errors.value("range_quadratic", 2) * measured.square()
        measured = measured + sigma * draws.range_noise
    if errors.uses("range_step"):
        measured = quantise(measured, errors.value("range_step", 2))
    return points * (measured / d.clamp(min=1e-6))[..., None]


def _point_sigma(errors: DomainRandomization, draws: Draws) -> Tensor:
    """Return the standard deviation (B, M or 1) [m] of each point's noise."""
    if draws.outlier is None:
        return errors.value("point_noise", 2)
    is_outlier = draws.outlier < errors.value("outliers", 2)
    return torch.where(is_outlier, errors.value("outlier_noise", 2), errors.value("point_noise", 2))


def _drop(errors: DomainRandomization, points: Tensor, draws: Draws) -> Tensor:
    """Turn lost points and lost clouds into NaN."""
    if draws.dropped is None or draws.missed is None:
        return points
    is_lost = (draws.missed < errors.value("missed_frames", 2)) | (draws.dropped < errors.value("dropout", 2))
    return points.masked_fill(is_lost[..., None], float("nan"))
