"""The mean of all points of a cell."""

from benchmarks.peers.peer import PointMap


class Map(PointMap):
    """The mean height of each cell."""

    TITLE, SETTINGS, NEEDS, TAKES = "mean of each cell", "all points weigh the same, none is forgotten", "", "points"
