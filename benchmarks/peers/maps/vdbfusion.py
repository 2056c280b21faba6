"""VDBFusion, a truncated signed distance from points."""

import numpy as np
import vdbfusion

from benchmarks.peers.maps._mesh import drop_rays
from benchmarks.peers.peer import Array, Frame, Setup


class Map:
    """A volume of OpenVDB; the ground is where a ray from above meets its mesh."""

    TITLE, NEEDS, TAKES = "VDBFusion", "vdbfusion", "points"
    SETTINGS = "voxels as large as cells, truncation of 3 voxels, no space carving: its defaults"

    def __init__(self, setup: Setup) -> None:
        self.setup = setup
        self.volume = vdbfusion.VDBVolume(setup.resolution, 3 * setup.resolution, False)

    def update(self, frame: Frame) -> None:
        """Integrate the points."""
        self.volume.integrate(frame.placed(), np.ascontiguousarray(frame.T_map_sensor[:3, 3]))

    def ground(self) -> "tuple[Array, Array | None]":
        """Return the heights of its mesh."""
        vertices, triangles = self.volume.extract_triangle_mesh(False, 3.0)
        return drop_rays(np.asarray(vertices), np.asarray(triangles), self.setup), None
