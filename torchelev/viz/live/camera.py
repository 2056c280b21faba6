"""Where the browsers' cameras are: at first looking at the whole map, then following the robot if asked to."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from torchelev.io.export import SavedMap

_DIRECTION = np.array([-0.35, -0.5, 0.5])  # from the map's centre to the camera, in lengths of the map
_RIGHT = np.array([-_DIRECTION[1], _DIRECTION[0], 0.0]) / np.hypot(*_DIRECTION[:2])  # of that camera
_ASIDE = 0.16  # [lengths of the map] to the left of the middle, as the panel covers the right of the page


class Camera:
    """The cameras of all browsers.

    Args:
        server: viser's.
    """

    def __init__(self, server: Any) -> None:
        self._server = server
        self._followed: NDArray[np.float64] | None = None
        self._has_looked = False

    def look_at_map(self, saved: SavedMap, origin: NDArray[np.float64]) -> None:
        """Look at the whole map: browsers that are there at the first call, and those that open the page later.

        Args:
            saved: the map.
            origin: (3,) [m] of the scene, map frame.
        """
        heights = saved.layers["elevation"]
        ground = float(np.nanmedian(heights)) if np.isfinite(heights).any() else float(saved.center[2])
        target = np.append(saved.center[:2], ground) - origin
        length = max(heights.shape) * saved.resolution
        target = target + _ASIDE * length * _RIGHT
        position = target + _DIRECTION * length
        cameras = [self._server.initial_camera]
        if not self._has_looked:
            cameras += [client.camera for client in self._server.get_clients().values()]
        for camera in cameras:
            camera.position, camera.look_at = position, target
        self._has_looked = True

    def follow(self, position: NDArray[np.float64] | None) -> None:
        """Move the cameras as the robot has moved since the call before.

        Args:
            position: (3,) [m] of the base; None: do not follow.
        """
        if position is not None and self._followed is not None:
            moved = position - self._followed
            for client in self._server.get_clients().values():
                place, target = client.camera.position, client.camera.look_at
                client.camera.position, client.camera.look_at = place + moved, target + moved
        self._followed = position
