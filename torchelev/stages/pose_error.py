"""The uncertainty of the sensor's pose: what a scan's heights share, and what every height of the map shares."""

from __future__ import annotations

from typing import TYPE_CHECKING

import torch
from torch import Tensor

from torchelev.state import MapState, Measurement

if TYPE_CHECKING:
    from jaxtyping import Bool, Float


def project_covariance(
    relative: Float[Tensor, "B 3 M"], covariance: Float[Tensor, "B S 6 6"], dtype: torch.dtype
) -> Float[Tensor, "B M"]:
    """Return the variance [m^2] that the sensor's pose gives to the height of each point.

    J Sigma J^T with J = (0, 0, 1, r_y, -r_x, 0), where r is the point less the sensor's position in map axes (the
    sensor model of Fankhauser et al. 2018, which the paper builds on): errors of roll and pitch tilt the scan.
    """
    sensors = covariance.shape[1]
    r_x, r_y = relative[:, :2].unflatten(-1, (sensors, -1)).unbind(1)
    C = covariance.to(dtype)[..., None]
    zz, zr, zp, rr, rp, pp = (C[:, :, i, j] for i, j in ((2, 2), (2, 3), (2, 4), (3, 3), (3, 4), (4, 4)))
    variance = zz + 2 * (zr * r_y - zp * r_x) + rr * r_y.square() - 2 * rp * r_x * r_y + pp * r_x.square()
    return variance.clamp(min=0).flatten(1)


def share_pose_error(state: MapState, m: Measurement, follows: Bool[Tensor, "B"], max_variance: float) -> MapState:
    """Note how uncertain the position is that the map's heights count from.

    A map that drift compensation has moved to the scan, or that begins with it, is as far off in height as the scan:
    its heights share the error of the pose, which no number of scans reduces. Elsewhere the scan is a measurement of
    its own, and what the heights shared becomes part of each one's variance, up to `max_variance` [m^2].
    """
    if m.pose_covariance is None:
        return state
    follows = follows | ~state.validity.flatten(1).any(1)
    shared = torch.where(follows, 0.0, state.pose_covariance[:, 2, 2])
    covariance = m.pose_covariance.clone()
    is_height = torch.zeros_like(covariance, dtype=torch.bool)
    is_height[:, 2] = is_height[:, :, 2] = True
    variance = (state.variance + shared[:, None, None]).clamp(max=max_variance)
    return state._replace(
        variance=torch.where(state.validity, variance, state.variance),
        pose_covariance=torch.where(is_height & ~follows[:, None, None], 0.0, covariance),
    )


def relative_variance(state: MapState, m: Measurement) -> Float[Tensor, "B M"] | None:
    """Return what the pose adds to the variance of each point, less what all heights of the map share [m^2]."""
    if m.noise is None:
        return None
    return (m.variance - m.noise - state.pose_covariance[:, 2, 2, None]).clamp(min=0)
