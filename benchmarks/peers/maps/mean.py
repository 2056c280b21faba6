"""The mean of all points of a cell."""

from benchmarks.peers.peer import Array, Cells, Frame, Setup


class Map:
    """A running mean in each cell."""

    TITLE, SETTINGS, NEEDS, TAKES = "mean of each cell", "all points count the same, for ever", "", "points"

    def __init__(self, setup: Setup) -> None:
        self.cells = Cells(setup)

    def update(self, frame: Frame) -> None:
        """Add the points."""
        self.cells.add(frame.placed())

    def ground(self) -> "tuple[Array, Array | None]":
        """Return the means and their standard errors."""
        return self.cells.mean()
