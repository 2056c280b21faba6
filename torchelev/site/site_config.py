"""Settings of a site."""

from __future__ import annotations

from dataclasses import dataclass

from torchelev.errors import require, require_count, require_positive


@dataclass(frozen=True, kw_only=True)
class SiteConfig:
    """How windows are aligned and fused."""

    #: [m^2/s] added to the variance of cells while nobody measures them; None: the `aging.variance_rate` of the first
    #: map that is merged
    variance_rate: float | None = None
    gate: float = 4.0  #: Mahalanobis distance beyond which two heights of a cell contradict each other
    max_gate_std: float = 0.03  #: [m] the gate of uncertain heights grows no wider, or steps would be averaged
    #: a newer height replaces one that it contradicts once its variance is at most so many times that one's
    max_newer_ratio: float = 4.0
    max_slope: float = 0.3  #: rise over run, of the cells whose heights are compared to find the offsets
    max_std: float = 0.05  #: [m] of these cells
    min_overlap: int = 20  #: such cells that two windows, or a window and the site, must share to be compared
    max_compared: int = 32768  #: cells of all windows that are compared; more are thinned on the lattice
    cache_tiles: int = 256  #: tiles of a site on disk that stay in memory: 29 MB
    #: once in so many merges, all versions but so many of the newest and those with tags are dropped
    keep_versions: int = 100

    def __post_init__(self) -> None:
        names = ("gate", "max_gate_std", "max_newer_ratio", "max_slope", "max_std")
        require_positive(**{f"cfg.{name}": getattr(self, name) for name in names})
        for name in ("min_overlap", "max_compared", "cache_tiles", "keep_versions"):
            require_count(f"cfg.{name}", getattr(self, name), "see its default")
        rate = self.variance_rate
        require(rate is None or rate >= 0, "cfg.variance_rate", "must not be negative", rate, "give m^2/s")
