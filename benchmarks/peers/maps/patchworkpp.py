"""Patchwork++ finds the ground of each scan; cells hold the mean of its points."""

import numpy as np
import pypatchworkpp

from benchmarks.peers.peer import Frame, PointMap, Setup


class Map(PointMap):
    """Ground points of each scan, and their mean in each cell."""

    TITLE, NEEDS, TAKES = "Patchwork++, mean", "pypatchworkpp", "points"
    SETTINGS = "sensor_height of the robot, min_range 0.2 m in place of 2.7 m, no intensity; its ground points averaged"

    def __init__(self, setup: Setup) -> None:
        super().__init__(setup)
        parameters = pypatchworkpp.Parameters()
        parameters.sensor_height, parameters.verbose = setup.sensor_height, False
        parameters.min_range, parameters.max_range, parameters.enable_RNR = 0.2, setup.max_range, False
        self.finder = pypatchworkpp.patchworkpp(parameters)

    def update(self, frame: Frame) -> None:
        """Find the ground, with the axes of the map and the sensor at the origin, and add it."""
        placed, origin = frame.placed(), frame.T_map_sensor[:3, 3]
        self.finder.estimateGround((placed - origin).astype(np.float32))
        self.cells.add(placed[np.asarray(self.finder.getGroundIndices(), dtype=np.int64)])
