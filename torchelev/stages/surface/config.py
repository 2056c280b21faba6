"""The window of the planes that normals are fitted to."""

from __future__ import annotations

from dataclasses import dataclass

from torchelev.errors import require
from torchelev.plane_fit import MAX_RADIUS


@dataclass(frozen=True, kw_only=True)
class SurfaceConfig:
    """How far the plane of a normal reaches."""

    radius: int = 1  #: [cells] 1: the 3 x 3 neighbours

    def __post_init__(self) -> None:
        require(self.radius >= 1, "surface.radius", "must be at least 1 cell", self.radius, "give 1")
        most = self.radius <= MAX_RADIUS
        require(most, "surface.radius", f"must be at most {MAX_RADIUS} cells", self.radius, "give 1")
