"""The cloth simulation filter finds the ground of each scan; cells hold the mean of its points."""

import CSF
import numpy as np

from benchmarks.peers.peer import Frame, PointMap, Setup


class Map(PointMap):
    """Ground points of each scan, and their mean in each cell."""

    TITLE, NEEDS, TAKES = "cloth filter (CSF), mean", "CSF", "points"
    SETTINGS = "cloth of 0.2 m, rigidness 1, threshold 0.1 m, slopes smoothed; its ground points averaged"

    def __init__(self, setup: Setup) -> None:
        super().__init__(setup)
        self.filter = CSF.CSF()
        parameters = self.filter.params
        parameters.cloth_resolution, parameters.rigidness = 0.2, 1
        parameters.class_threshold, parameters.bSloopSmooth = 0.1, True

    def update(self, frame: Frame) -> None:
        """Find the ground and add it."""
        placed, ground, others = frame.placed(), CSF.VecInt(), CSF.VecInt()
        self.filter.setPointCloud(placed)
        self.filter.do_filtering(ground, others, False)
        self.cells.add(placed[np.array(ground, dtype=np.int64)])
