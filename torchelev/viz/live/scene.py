"""The objects of a snapshot in viser's scene: surface, upper bound, frames, path, points and planes."""

from __future__ import annotations

import contextlib
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from torchelev.planes import segment
from torchelev.viz.live.snapshot import BOUND, CEILING, CLOUD, FRAMES, PATH, PLAN, PLANES, SCAN, Snapshot
from torchelev.viz.live.surface import bound_sheet, ceiling_sheet, surface

_COLORS = {BOUND: (70, 115, 190), CEILING: (150, 120, 170), CLOUD: (230, 60, 60), SCAN: (240, 228, 66)}
_COLORS |= {PATH: (213, 94, 0), PLAN: (230, 159, 0)}
_OUTLINE, _HOLE = (0, 114, 178), (204, 121, 167)
_LIFT = 0.01  # [m] height of lines above the surface, which would hide them
_MAX_PATH = 5_000


class Scene:
    """Draws snapshots. An object that a snapshot lacks is removed.

    Args:
        server: viser's.

    Attributes:
        origin: (3,) [m] where the scene's origin is in the map frame, near the map, so that float32 is precise.
    """

    def __init__(self, server: Any) -> None:
        self._scene = server.scene
        self._scene.set_up_direction("+z")
        self.origin = np.zeros(3)
        self._drawn: dict[str, Any] = {}

    def draw(self, snapshot: Snapshot, colors: NDArray[np.uint8], path: NDArray, parts: set[str]) -> None:
        """Draw a snapshot.

        Args:
            snapshot: what to draw.
            colors: (H, W, 4) of the cells, sRGB.
            path: (T, 3) [m] of the base so far, map frame.
            parts: names of `PARTS` to draw beside the surface.
        """
        before, self._drawn = self._drawn, {}
        self._draw_surface(snapshot, colors)
        if BOUND in parts:
            self._draw_ghost(BOUND, *bound_sheet(snapshot.map, self.origin), opacity=0.45)
        if CEILING in parts:
            self._draw_ghost(CEILING, *ceiling_sheet(snapshot.map, self.origin), opacity=0.25)
        if FRAMES in parts:
            self._draw_frames(snapshot)
        for name, points, size in ((CLOUD, snapshot.cloud, 0.015), (SCAN, snapshot.scan, 0.03)):
            if name in parts and len(points):
                self._keep(name, self._scene.add_point_cloud, self._local(points), _COLORS[name], point_size=size)
        for name, line in ((PATH, path), (PLAN, snapshot.plan)):
            if name in parts and len(line) > 1:
                line = line[:: -(-len(line) // _MAX_PATH)]
                self._draw_lines(name, np.stack([line[:-1], line[1:]], 1), _COLORS[name])
        if PLANES in parts:
            self._draw_planes(snapshot)
        for name in before.keys() - self._drawn.keys():
            with contextlib.suppress(KeyError):
                before[name].remove()

    def _local(self, points: NDArray) -> NDArray[np.float32]:
        return (points - self.origin).astype(np.float32)

    def _keep(self, name: str, add: Any, *args: Any, **kwargs: Any) -> None:
        """Add an object, in place of the one of this name before."""
        self._drawn[name] = add(f"/{name}", *args, **kwargs)

    def _draw_surface(self, snapshot: Snapshot, colors: NDArray[np.uint8]) -> None:
        mesh = surface(snapshot.map, colors, self.origin)
        if mesh:
            self._keep("map", self._scene.add_glb, mesh, cast_shadow=False, receive_shadow=False)

    def _draw_ghost(self, name: str, vertices: NDArray, triangles: NDArray, opacity: float) -> None:
        """Draw a sheet that one can see through, unless it is empty."""
        if len(triangles):
            ghost = {"color": _COLORS[name], "opacity": opacity, "side": "double", "cast_shadow": False}
            self._keep(name, self._scene.add_mesh_simple, vertices, triangles, **ghost)

    def _draw_frames(self, snapshot: Snapshot) -> None:
        if snapshot.T_map_base is not None:
            self._draw_frame("base", snapshot.T_map_base, 0.4)
        for k, T in enumerate(() if snapshot.T_map_sensor is None else snapshot.T_map_sensor):
            self._draw_frame(f"sensor {k}", T, 0.25)

    def _draw_frame(self, name: str, T: NDArray, length: float) -> None:
        from viser.transforms import SO3

        wxyz = SO3.from_matrix(T[:3, :3]).wxyz
        position = self._local(T[:3, 3])
        add = self._scene.add_frame
        self._keep(name, add, wxyz=wxyz, position=position, axes_length=length, axes_radius=length / 25)

    def _draw_planes(self, snapshot: Snapshot) -> None:
        saved = snapshot.map
        heights, center = torch.as_tensor(saved.layers["elevation"])[None], torch.as_tensor(saved.center)[None]
        regions = segment(heights, saved.resolution, center=center)[0].regions
        rings = [(region.boundary, _OUTLINE) for region in regions]
        rings += [(ring, _HOLE) for region in regions for ring in region.holes]
        sides = [np.stack([ring, np.roll(ring, -1, axis=0)], 1) for ring, _ in rings]
        if sides:
            colors = np.concatenate([np.tile(color, (len(ring), 2, 1)) for ring, color in rings])
            self._draw_lines(PLANES, np.concatenate(sides), colors)

    def _draw_lines(self, name: str, segments: NDArray, colors: Any) -> None:
        segments = self._local(segments) + np.array([0, 0, _LIFT], np.float32)
        self._keep(name, self._scene.add_line_segments, segments, colors, thickness=3.0, thickness_units="screen")
