"""A truncated signed distance of Open3D, from depth images."""

import numpy as np
import open3d as o3d

from benchmarks.peers.maps._mesh import drop_rays
from benchmarks.peers.peer import Array, Frame, Setup

OPTICAL = np.array([[0.0, -1, 0, 0], [0, 0, -1, 0], [1, 0, 0, 0], [0, 0, 0, 1]])  # of a point: right, down, forward


class Map:
    """A scalable volume; the ground is where a ray from above meets its mesh."""

    TITLE, NEEDS, TAKES = "Open3D TSDF", "open3d", "depth"
    SETTINGS = "ScalableTSDFVolume, voxels as large as cells, truncation of 4 voxels, depth to the sensor's range"

    def __init__(self, setup: Setup) -> None:
        assert setup.pinhole is not None
        self.setup, self.size, kinds = setup, setup.pinhole[:2], o3d.pipelines.integration
        kind = kinds.TSDFVolumeColorType.NoColor
        self.volume = kinds.ScalableTSDFVolume(setup.resolution, 4 * setup.resolution, kind)
        self.intrinsic = o3d.camera.PinholeCameraIntrinsic(*setup.pinhole)
        width, height = self.size
        self.black = o3d.geometry.Image(np.zeros((height, width, 3), np.uint8))

    def update(self, frame: Frame) -> None:
        """Integrate the depth image."""
        width, height = self.size
        depth = np.nan_to_num(frame.points[:, 0]).reshape(height, width)
        image = o3d.geometry.RGBDImage.create_from_color_and_depth(
            self.black, o3d.geometry.Image(depth), 1.0, self.setup.max_range, False
        )
        self.volume.integrate(image, self.intrinsic, OPTICAL @ np.linalg.inv(frame.T_map_sensor))

    def ground(self) -> "tuple[Array, Array | None]":
        """Return the heights of its mesh."""
        mesh = self.volume.extract_triangle_mesh()
        return drop_rays(np.asarray(mesh.vertices), np.asarray(mesh.triangles), self.setup), None
