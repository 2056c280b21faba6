"""How fast estimates lose certainty."""

from __future__ import annotations

from dataclasses import dataclass

from torchelev.errors import require


@dataclass(frozen=True, kw_only=True)
class AgingConfig:
    """Process noise: how fast the variance of a cell grows."""

    variance_rate: float = 1e-7  #: [m^2/s] sigma_t^2 per second: a standard deviation of 1 cm after 17 minutes

    def __post_init__(self) -> None:
        rate = self.variance_rate
        require(rate >= 0, "aging.variance_rate", "must not be negative", rate, "give m^2/s")
