"""The stage: the map as a lit surface, the robot and the view of its camera, rendered off screen.

Needs pyvista (``pip install pyvista``), a dependency of this picture alone.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import pyvista as pv
from numpy.typing import NDArray
from PIL import Image

from docs.moving_picture.legs import leg_joints
from docs.moving_picture.surface import surface
from docs.moving_picture.walk import CAMERA, GRID, Moment, Path
from torchelev.viz.palette import HEIGHTS

CMAP, LIMITS = HEIGHTS, (-0.5, 0.8)  # [m]
BACKGROUND = "#ffffff"
_SUPERSAMPLING = 2
_CAMERA = (5.1, -7.0, 6.6), (1.0, 0.0, -0.2)  # [m] position and focus
_MATT = {"ambient": 0.35, "diffuse": 0.85, "specular": 0.05}
_BODY, _DARK, _VIEW = "#f4f4f2", "#2b2f36", "#ff7a1a"


def add_lights(plotter: pv.Plotter) -> None:
    """Light a scene from the left, with soft shadows in its corners."""
    for position, intensity in (((-4, -6, 9), 0.75), ((6, 2, 5), 0.25), ((0, -8, 3), 0.2)):
        plotter.add_light(pv.Light(position=position, focal_point=(0, 0, 0), intensity=intensity))
    plotter.enable_ssao(radius=0.35, bias=0.01, kernel_size=64, blur=True)


class Stage:
    """A window without a screen, in which one frame after another is rendered.

    Args:
        path: the robot's path.
        size: (width, height) of a frame [pixels].
    """

    def __init__(self, path: Path, size: tuple[int, int]) -> None:
        self.path = path
        window = [_SUPERSAMPLING * length for length in size]
        self.plotter = pv.Plotter(off_screen=True, window_size=window, lighting="none")
        self.plotter.set_background(BACKGROUND)
        self.plotter.camera_position = [*_CAMERA, (0, 0, 1)]
        self.plotter.camera.view_angle = 36
        add_lights(self.plotter)

    def render(self, moment: Moment) -> Image.Image:
        """Return a frame. The camera stands still, so that a film repeats what does not change."""
        self._draw_map(moment)
        self._draw_robot(moment)
        self._draw_view(moment)
        self.plotter.render()
        frame = Image.fromarray(np.asarray(self.plotter.screenshot(return_img=True))[..., :3])
        return frame.reduce(_SUPERSAMPLING)

    def _draw_map(self, moment: Moment) -> None:
        mesh = surface(moment.xy, moment.elevation, GRID.resolution)
        self._add("map", mesh, scalars="values", cmap=CMAP, clim=LIMITS, show_scalar_bar=False, **_MATT)

    def _draw_robot(self, moment: Moment) -> None:
        body = pv.Cube(x_length=0.66, y_length=0.26, z_length=0.15)
        head = pv.Cube(center=(0.36, 0, 0.05), x_length=0.1, y_length=0.2, z_length=0.09)
        pack = pv.Cube(center=(-0.06, 0, 0.1), x_length=0.34, y_length=0.2, z_length=0.06)
        legs = pv.MultiBlock([self._link(a, b, r) for a, b, r in self._links(moment.seconds)]).combine()
        for name, mesh, color in (("body", body, _BODY), ("head", head, _DARK), ("pack", pack, _DARK)):
            self._solid(name, mesh.transform(moment.T_map_base, inplace=False), color)
        self._solid("legs", legs.extract_surface(algorithm=None), _DARK)

    def _links(self, seconds: float) -> list[tuple[NDArray, NDArray, float]]:
        joints = leg_joints(self.path, seconds)
        return [link for hip, knee, foot in joints for link in ((hip, knee, 0.042), (knee, foot, 0.026))]

    @staticmethod
    def _link(a: NDArray, b: NDArray, radius: float) -> pv.PolyData:
        return pv.Capsule(
            center=(a + b) / 2, direction=b - a, radius=radius, cylinder_length=float(np.linalg.norm(b - a))
        )

    def _solid(self, name: str, mesh: pv.DataSet, color: str) -> None:
        self._add(name, mesh, color=color, ambient=0.35, diffuse=0.7, specular=0.2)

    def _draw_view(self, moment: Moment) -> None:
        """Draw the camera's view: a pyramid that ends on the ground."""
        points = np.vstack([moment.T_map_sensor[:3, 3], moment.view])
        ring = np.arange(1, len(points))
        following = np.roll(ring, -1)
        sides = np.column_stack([np.full_like(ring, 3), np.zeros_like(ring), ring, following])
        w, h = CAMERA.width, CAMERA.height
        corners = 1 + np.array([0, w - 1, w + h - 2, 2 * w + h - 3])
        edges = np.vstack([np.column_stack([np.full_like(ring, 2), ring, following]), [[2, 0, k] for k in corners]])
        self._glow("view", pv.PolyData(points, sides.ravel()), opacity=0.13)
        self._glow("edges", pv.PolyData(points, lines=edges.ravel()), line_width=4.0)

    def _glow(self, name: str, mesh: pv.DataSet, **style: float) -> None:
        self._add(name, mesh, color=_VIEW, lighting=False, **style)

    def _add(self, name: str, mesh: pv.DataSet, **style: Any) -> None:
        """Add a mesh, or replace the one of the last frame."""
        self.plotter.add_mesh(mesh, name=name, reset_camera=False, render=False, **style)
