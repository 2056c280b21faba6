"""The window of the planes that normals are fitted to."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from torchelev.errors import require, require_count
from torchelev.plane_fit import MAX_RADIUS
from torchelev.stages.by_tensors import ByTensors


@dataclass(frozen=True, kw_only=True)
class UpperBoundConfig(ByTensors):
    """Normals, and a rating, of the upper bound as in elevation_mapping_cupy. Uses tensor operations."""

    dilation: int = 3  #: [cells] distance within which unknown ground takes the height of a known or bounded cell
    #: .npz of that package's traversability filter, see `PaperFilter.from_npz`; None: `traversability` rates
    filter_weights: str | Path | None = None

    def __post_init__(self) -> None:
        require_count("surface.upper_bound.dilation", self.dilation, "give 3", 0)
        if isinstance(self.filter_weights, Path):
            object.__setattr__(self, "filter_weights", str(self.filter_weights))  # as files of settings hold it


@dataclass(frozen=True, kw_only=True)
class SurfaceConfig:
    """Window of the plane that is fitted for a normal."""

    radius: int = 1  #: [cells] radius of the window; 1: the 3 x 3 neighbours
    upper_bound: UpperBoundConfig | None = None  #: normals of the upper bound; None: normals of the elevation

    def __post_init__(self) -> None:
        require(self.radius >= 1, "surface.radius", "must be at least 1 cell", self.radius, "give 1")
        most = self.radius <= MAX_RADIUS
        require(most, "surface.radius", f"must be at most {MAX_RADIUS} cells", self.radius, "give 1")
