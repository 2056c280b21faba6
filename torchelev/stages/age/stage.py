"""Time passes: certainty fades."""

from __future__ import annotations

from typing import TYPE_CHECKING

import torch
from torch import Tensor

from torchelev.stages.age.config import AgingConfig
from torchelev.state import MapState, Measurement

if TYPE_CHECKING:
    from jaxtyping import Float, Int


def age(state: MapState, m: Measurement, cfg: AgingConfig, max_variance: float) -> MapState:
    """Advance the clocks and add the time variance, sigma_m^2 += sigma_t^2 * dt (paper, Sec. II-C).

    Of known cells only. No variance grows beyond `max_variance` [m^2], so that cells without points need no limit in
    `fuse`.
    """
    dt = m.dt[:, None, None]
    variance = (state.variance + cfg.variance_rate * dt).clamp(max=max_variance)
    return state._replace(
        elapsed=state.elapsed + nanoseconds(m.dt),
        time=state.time + dt * state.validity,
        variance=torch.where(state.validity, variance, state.variance),
    )


def nanoseconds(dt: Float[Tensor, "B"]) -> Int[Tensor, "B"]:
    """Return a time [s] in whole nanoseconds, whose sum has no rounding errors. No gradient."""
    return torch.round(dt.detach().double() * 1e9).to(torch.int64)
