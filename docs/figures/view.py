"""A view of maps as lit 3-D surfaces with paths and robots, on a transparent ground for light and dark pages.

Needs pyvista (``pip install pyvista``).
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pyvista as pv
from numpy.typing import NDArray
from PIL import Image

from docs.moving_picture.stage import add_lights
from docs.moving_picture.surface import surface
from torchelev.files.output_files import atomic_file
from torchelev.viz.palette import HEIGHTS, ROBOT_COLOR

SIZE = (1200, 640)  # [pixels]
_SUPERSAMPLING = 2
_QUALITY = 82  # of WebP
_MARGIN = 12  # [pixels] around what is drawn
_RIM = 12  # [pixels] of the window, before it is reduced, in which the soft shadows are wrong
_DARK = 0.35  # of the range of heights: colours too dark for dark pages, which are left out
_MATT = {"ambient": 0.35, "diffuse": 0.85, "specular": 0.05}
Place = tuple[float, float, float]  # [m]


class View:
    """A window without a screen, in which surfaces, paths and solids are drawn.

    Args:
        position: of the eye [m].
        focus: what it looks at [m].
        angle_deg: vertical angle of the view.
    """

    def __init__(self, position: Place, focus: Place, angle_deg: float = 30.0) -> None:
        window = [_SUPERSAMPLING * length for length in SIZE]
        self.plotter = pv.Plotter(off_screen=True, window_size=window, lighting="none")
        add_lights(self.plotter)
        self.plotter.camera_position = [position, focus, (0, 0, 1)]
        self.plotter.camera.view_angle = angle_deg

    def add_map(self, xy: NDArray, heights: NDArray, values: NDArray | None = None, **style: Any) -> None:
        """Add the known cells of a map.

        Args:
            xy: (H, W, 2) [m] centres of the cells.
            heights: (H, W) [m], NaN where unknown.
            values: (H, W) what is coloured; None: the heights, from the colours' second quarter on.
            **style: of `pyvista.Plotter.add_mesh`.
        """
        mesh = surface(xy, heights, float(xy[1, 0, 0] - xy[0, 0, 0]), values)
        low, high = (float(v) for v in np.nanpercentile(heights, [1, 99]))
        high = max(high, low + 0.2)
        colors = {"cmap": HEIGHTS, "clim": (low - _DARK * (high - low), high)} | style
        self._add(mesh, scalars="values", show_scalar_bar=False, **colors, **_MATT)

    def add_path(self, places: NDArray, color: Any = ROBOT_COLOR, radius: float = 0.025) -> None:
        """Draw a path (T, 3) [m] as a tube."""
        is_new = np.r_[True, np.linalg.norm(np.diff(places, axis=0), axis=1) > 1e-3]
        self.add_solid(pv.MultipleLines(points=places[is_new]).tube(radius=radius), color)

    def add_solid(self, mesh: pv.DataSet, color: Any) -> None:
        """Draw a mesh in one colour."""
        self._add(mesh, color=color, ambient=0.35, diffuse=0.7, specular=0.2)

    def _add(self, mesh: pv.DataSet, **style: Any) -> None:
        self.plotter.add_mesh(mesh, reset_camera=False, render=False, **style)

    def save(self, path: Path) -> None:
        """Write what is seen as WebP, and close the window."""
        save_cut_out(self.plotter, path)


def save_cut_out(plotter: pv.Plotter, path: Path) -> None:
    """Write what a window shows, without its ground, as WebP, and close the window."""
    picture = cut_out(plotter).reduce(_SUPERSAMPLING)
    plotter.close()
    left, top, right, bottom = picture.getchannel("A").point(_is_seen).getbbox() or (0, 0, *picture.size)
    width, height = picture.size
    box = max(0, left - _MARGIN), max(0, top - _MARGIN), min(width, right + _MARGIN), min(height, bottom + _MARGIN)
    with atomic_file(path) as file:
        picture.crop(box).save(file, format="webp", quality=_QUALITY, method=6)


def _is_seen(alpha: int) -> int:
    return 255 if alpha > 16 else 0


def cut_out(plotter: pv.Plotter) -> Image.Image:
    """Return what a window shows with the opacity of each pixel, from how it looks on white and on black."""
    on_white, on_black = (_shoot(plotter, ground) for ground in ("white", "black"))
    alpha = (1 - (on_white - on_black).mean(-1, keepdims=True)).clip(0, 1)
    alpha[:_RIM], alpha[-_RIM:], alpha[:, :_RIM], alpha[:, -_RIM:] = 0, 0, 0, 0
    color = np.divide(on_black, alpha, out=np.zeros_like(on_black), where=alpha > 1e-3).clip(0, 1)
    return Image.fromarray((255 * np.concatenate([color, alpha], -1)).round().astype(np.uint8), "RGBA")


def _shoot(plotter: pv.Plotter, ground: str) -> NDArray:
    """Return a picture (h, w, 3) from 0 to 1 on a ground."""
    plotter.set_background(ground)
    plotter.render()
    return np.asarray(plotter.screenshot(return_img=True))[..., :3].astype(np.float64) / 255
