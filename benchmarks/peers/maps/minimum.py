"""The lowest point of a cell."""

import numpy as np

from benchmarks.peers.peer import Array, PointMap


class Map(PointMap):
    """The lowest height ever measured in each cell."""

    TITLE, SETTINGS, NEEDS, TAKES = "minimum of each cell", "of all points", "", "points"

    def ground(self) -> "tuple[Array, Array | None]":
        """Return the lowest heights."""
        lowest = self.cells.lowest
        return np.where(np.isfinite(lowest), lowest, np.nan).reshape(self.cells.shape), None
