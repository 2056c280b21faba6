"""OctoMap by pyoctomap."""

import numpy as np
import pyoctomap

from benchmarks.peers.peer import Array, Cells, Frame, Setup


class Map:
    """An octree of occupancy; the ground is the highest occupied voxel of a column."""

    TITLE, NEEDS, TAKES = "OctoMap", "pyoctomap", "points"
    SETTINGS = "voxels as large as cells, default probabilities, rays to the sensor's range"

    def __init__(self, setup: Setup) -> None:
        self.setup, self.tree = setup, pyoctomap.OcTree(setup.resolution)
        self.low, self.high = np.inf, -np.inf  # of the points

    def update(self, frame: Frame) -> None:
        """Insert the cloud."""
        placed, origin = frame.placed(), np.ascontiguousarray(frame.T_map_sensor[:3, 3])
        self.tree.insertPointCloud(placed, origin, max_range=self.setup.max_range)
        self.low, self.high = min(self.low, placed[:, 2].min()), max(self.high, placed[:, 2].max())

    def ground(self) -> "tuple[Array, Array | None]":
        """Return the middle of the highest occupied voxel of each column."""
        size, centers = self.setup.resolution, Cells(self.setup).centers().reshape(-1, 2)
        height = np.full(len(centers), np.nan)
        for z in size * (np.arange(np.floor(self.low / size), np.ceil(self.high / size)) + 0.5):
            labels = np.asarray(self.tree.getLabels(np.column_stack([centers, np.full(len(centers), z)])))
            height[labels.ravel() == 1] = z
        return height.reshape(self.setup.cells), None
