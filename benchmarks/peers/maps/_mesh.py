"""The ground of a mesh, for peers that make one."""

import numpy as np
import open3d as o3d

from benchmarks.peers.peer import Array, Cells, Setup


def drop_rays(vertices: Array, triangles: Array, setup: Setup) -> Array:
    """Return the height [m] at which a ray from above meets a mesh at the centre of each cell, NaN where none does."""
    top = float(vertices[:, 2].max()) + 1.0 if len(vertices) else 0.0
    scene = o3d.t.geometry.RaycastingScene()
    if len(triangles):
        scene.add_triangles(vertices.astype(np.float32), triangles.astype(np.uint32))
    rays = np.zeros((*setup.cells, 6), np.float32)  # origin and direction
    rays[..., :2], rays[..., 2], rays[..., 5] = Cells(setup).centers(), top, -1.0
    distance = scene.cast_rays(o3d.core.Tensor(rays))["t_hit"].numpy()
    return np.where(np.isfinite(distance), top - distance, np.nan)
