"""Which geoms of a MuJoCo model are the shapes of a robot, whether they collide or not."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray

_GROUND = ("mjGEOM_PLANE", "mjGEOM_HFIELD")
_MUCH_SMALLER = 0.5  # of a mesh's length: shapes shorter than that are not the mesh's


def robot_geoms(model: Any, link_of: Callable[[int], int], pose_of: Callable[[int, int], NDArray]) -> list[int]:
    """Return the geoms that are shapes of bodies that move.

    Those that collide count, and spheres, capsules, boxes and the like that do not, as models for MJX let feet collide
    alone. Meshes that do not collide are pictures, and count where a link has no shapes, or much smaller ones.

    Args:
        model: the `mujoco.MjModel`.
        link_of: returns the link that a body is fixed to.
        pose_of: returns T_link_geom (4, 4) from a geom and its link.
    """
    import mujoco

    moving = {int(model.body_rootid[k]) for k in range(1, model.nbody) if model.body_jntnum[k] > 0}
    ground = {int(getattr(mujoco.mjtGeom, name)) for name in _GROUND}
    shapes: dict[int, list[int]] = defaultdict(list)
    pictures: dict[int, list[int]] = defaultdict(list)
    for geom in range(model.ngeom):
        body, kind = int(model.geom_bodyid[geom]), int(model.geom_type[geom])
        if kind in ground or int(model.body_rootid[body]) not in moving:
            continue
        collides = model.geom_contype[geom] != 0 or model.geom_conaffinity[geom] != 0
        is_picture = kind == int(mujoco.mjtGeom.mjGEOM_MESH) and not collides
        (pictures if is_picture else shapes)[link_of(body)].append(geom)
    for link, geoms in pictures.items():
        size = [_extent(model, geom, pose_of(geom, link)) for geom in shapes[link]]
        if _length(size) < _MUCH_SMALLER * _length([_extent(model, geom, pose_of(geom, link)) for geom in geoms]):
            shapes[link] += geoms
    return sorted(geom for geoms in shapes.values() for geom in geoms)


def _extent(model: Any, geom: int, T_link_geom: NDArray) -> NDArray[np.float64]:
    """Return the lower and upper corner (2, 3) [m] of a geom in its link."""
    center, half = model.geom_aabb[geom].reshape(2, 3)
    middle = (T_link_geom @ [*center, 1.0])[:3]
    reach = np.abs(T_link_geom[:3, :3]) @ half
    return np.stack([middle - reach, middle + reach])


def _length(extents: list[NDArray]) -> float:
    """Return the largest side [m] of the box around geoms; 0 without any."""
    if not extents:
        return 0.0
    corners = np.stack(extents)
    return float((corners[:, 1].max(0) - corners[:, 0].min(0)).max())
