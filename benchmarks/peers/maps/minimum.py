"""The lowest point of a cell."""

import numpy as np

from benchmarks.peers.peer import Array, Cells, Frame, Setup


class Map:
    """The lowest height that was ever measured in each cell."""

    TITLE, SETTINGS, NEEDS, TAKES = "minimum of each cell", "of all points", "", "points"

    def __init__(self, setup: Setup) -> None:
        self.cells = Cells(setup)

    def update(self, frame: Frame) -> None:
        """Add the points."""
        self.cells.add(frame.placed())

    def ground(self) -> "tuple[Array, Array | None]":
        """Return the lowest heights."""
        lowest = self.cells.lowest
        return np.where(np.isfinite(lowest), lowest, np.nan).reshape(self.cells.shape), None
