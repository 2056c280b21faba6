"""How fast estimates lose certainty."""

from __future__ import annotations

from dataclasses import dataclass

from torchelev.errors import require


@dataclass(frozen=True, kw_only=True)
class AgingConfig:
    """How fast an estimate loses certainty while it is not measured."""

    variance_rate: float = 1e-7  #: [m^2/s] sigma_t^2 per second: 1 cm after 17 minutes

    def __post_init__(self) -> None:
        rate = self.variance_rate
        require(rate >= 0, "aging.variance_rate", "must not be negative", rate, "give m^2/s")
