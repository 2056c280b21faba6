"""Pictures of the quadruped on its terrain, with the cells of its map drawn over the ground."""

from __future__ import annotations

import weakref
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
import torch

from envs.quadruped.physics import ROBOT, build_model
from envs.quadruped.sight import MapSight
from envs.quadruped.task import Quadruped
from torchelev.errors import require

_HEIGHT, _WIDTH = 360, 480
_MAX_GEOMS = 20000
_LOW, _HIGH = np.array([0.1, 0.3, 0.8, 1.0]), np.array([1.0, 0.65, 0.1, 1.0])  # colours of low and high cells


class Camera:
    """Draws one robot of a task from the side, on its own tile.

    Args:
        task: The robots.

    Raises:
        RuntimeError: MuJoCo finds no OpenGL.
    """

    def __init__(self, task: Quadruped) -> None:
        self.tile = -1
        self.model: Any = None
        self.data: Any = None
        self.renderer: Any = None
        self._show_tile(task, int(task.tile_ids[0]))

    def _show_tile(self, task: Quadruped, tile: int) -> None:
        """Load the ground of a tile."""
        if tile == self.tile:
            return
        if self.renderer is not None:
            self.renderer.close()
        field = task.terrain.field
        self.model = build_model(ROBOT, field.heights[tile].cpu().numpy().astype(np.float64), field.resolution)
        self.data = mujoco.MjData(self.model)
        self.renderer, self.tile = open_renderer(self.model), tile

    def draw(self, task: Quadruped, index: int) -> np.ndarray:
        """Return a picture (360, 480, 3) of a robot."""
        self._show_tile(task, int(task.tile_ids[index]))
        self.data.qpos[:] = task.physics.qpos[index].numpy()
        self.data.qpos[:2] -= task.physics.tile_origins[task.tile_ids[index].cpu()].numpy()
        mujoco.mj_forward(self.model, self.data)
        view = mujoco.MjvCamera()
        view.lookat[:] = self.data.qpos[:3]
        view.distance, view.azimuth, view.elevation = 2.4, 120, -28
        self.renderer.update_scene(self.data, view)
        if isinstance(task.sight, MapSight):
            _draw_cells(self.renderer.scene, task.sight, index)
        return self.renderer.render().copy()


def open_renderer(model: Any) -> Any:
    """Return MuJoCo's renderer.

    Raises:
        RuntimeError: MuJoCo finds no OpenGL.
    """
    try:
        return mujoco.Renderer(model, _HEIGHT, _WIDTH, max_geom=_MAX_GEOMS)
    except Exception as error:  # whatever the platform's OpenGL raises
        raise RuntimeError(
            f"render: MuJoCo finds no OpenGL ({error}); without a screen install libegl1 and set MUJOCO_GL=egl"
        ) from error


def _draw_cells(scene: Any, sight: MapSight, index: int) -> None:
    """Add the known cells of a robot's map to a scene, coloured by height."""
    elevation = sight.emap.layer("elevation")[index]
    known = torch.isfinite(elevation)
    xy, z = sight.emap.cell_centers()[index][known].cpu().numpy(), elevation[known].cpu().numpy()
    if not len(z):
        return
    share = (z - z.min()) / max(float(np.ptp(z)), 0.1)
    half = 0.4 * sight.emap.cfg.grid.resolution
    for place, height, s in zip(xy, z, share, strict=True):
        if scene.ngeom >= scene.maxgeom:
            return
        mujoco.mjv_initGeom(
            scene.geoms[scene.ngeom], mujoco.mjtGeom.mjGEOM_BOX, np.array([half, half, 0.004]),
            np.array([*place, height]), np.eye(3).flatten(), (_LOW + (_HIGH - _LOW) * s).astype(np.float32),
        )  # fmt: skip
        scene.ngeom += 1


_CAMERAS: weakref.WeakKeyDictionary[Quadruped, Camera] = weakref.WeakKeyDictionary()


def draw(task: Quadruped, index: int = 0) -> np.ndarray:
    """Return a picture (360, 480, 3) of a robot of a task, with its map over the ground; see `Camera`."""
    if task not in _CAMERAS:
        _CAMERAS[task] = Camera(task)
    return _CAMERAS[task].draw(task, index)


def save_strip(pictures: list[np.ndarray], path: Path, count: int = 5) -> None:
    """Write `count` of the pictures, evenly spread, side by side as PNG.

    Raises:
        ValueError: There are no pictures.
    """
    from matplotlib.image import imsave

    require(len(pictures) > 0, "pictures", "must not be empty", "none", "draw some")
    chosen = [pictures[round(k * (len(pictures) - 1) / max(1, count - 1))] for k in range(count)]
    imsave(path, np.concatenate(chosen, 1))


def save_video(pictures: list[np.ndarray], path: Path, fps: int = 25) -> None:
    """Write pictures as an animated WebP, which browsers and GitHub show.

    Raises:
        ValueError: There are no pictures.
    """
    from PIL import Image

    require(len(pictures) > 0, "pictures", "must not be empty", "none", "draw some")
    first, *rest = [Image.fromarray(picture) for picture in pictures]
    first.save(path, save_all=True, append_images=rest, duration=round(1000 / fps), loop=0, quality=60, method=4)
