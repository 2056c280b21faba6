"""Maps of stairs that a robot has seen in part, with the true ground: scans of exact scenes, from exact poses."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, NamedTuple

import torch
import torch.nn.functional as F
from torch import Tensor

from torchelev import ElevationMap
from torchelev.completion.complete import CompletionInput
from torchelev.sim import DepthCamera, Lidar, Scene, mount, noisy
from torchelev.sim.exact.scenes import Box, block
from torchelev.sim.poses import pose
from training.completion.maps import TrueMap
from training.traversability.maps.mapping import blank_map, tile_cell_centers

if TYPE_CHECKING:
    from jaxtyping import Float

NUM_EDGES = 6
WINDOW = 4.0  # [m] side of a map
SENSORS = (  # pattern and mounting; each seed draws one
    (DepthCamera(), mount(pitch_deg=35.0, x=0.3, z=0.2)),
    (Lidar(rings=32, azimuths=512), mount(pitch_deg=0.0, z=0.3)),
)
_FAR = 20.0  # [m] from the first edge, where the scene ends
_SCANS, _STEP, _INTERVAL = 3, 0.1, 0.2  # number, [m] and [s] from one to the next
_DISTANCE = (0.3, 1.0)  # [m] of the robot from the first edge at the last scan
_HEIGHT = (0.35, 0.55)  # [m] of the base above the ground
_YAW = 0.4  # [rad] by which the robot's heading differs from the stairs' at most


@dataclass(frozen=True, kw_only=True)
class Stairs:
    """Stairs along +x, whose edge k is at x = k * run; the ground before edge 0 is at z = 0."""

    rise: float  #: [m] at each edge; negative: they go down
    run: float  #: [m] from edge to edge

    @property
    def scene(self) -> Scene:
        """The exact scene."""
        lowest = min(0.0, NUM_EDGES * self.rise)
        blocks = tuple(self._block(k) for k in range(NUM_EDGES))
        return Scene(terrain=lambda x, y: torch.full_like(x, lowest), boxes=blocks)

    def _block(self, k: int) -> Box:
        goes_up = self.rise > 0
        x0, x1 = (k * self.run, _FAR) if goes_up else (-_FAR, k * self.run)
        return block(x0, x1, -_FAR, _FAR, (k + goes_up) * self.rise)


class SeenStairs(NamedTuple):
    """Maps of B stairs."""

    maps: TrueMap
    stairs: tuple[Stairs, ...]
    T_center_stairs: Float[Tensor, "B 4 4"]  #: poses of the stairs in the frames of the maps' centers


def look_at(stairs: Sequence[Stairs], resolution: float, seed: int) -> SeenStairs:
    """Map each of some stairs by a robot that walks towards it.

    The sensor, the robot's height, heading and distance, and how the stairs lie to the cells are drawn from the seed.
    """
    generator = torch.Generator().manual_seed(seed)
    draw = torch.rand(5, len(stairs), generator=generator, dtype=torch.float64)
    (near, far), (low, high) = _DISTANCE, _HEIGHT
    distance, height, yaw = near + (far - near) * draw[0], low + (high - low) * draw[1], _YAW * (2 * draw[2] - 1)
    T_map_stairs = pose(F.pad(draw[3:].T, (0, 1)), 2 * torch.pi * draw[4])
    pattern, T_base_sensor = SENSORS[int(torch.randint(len(SENSORS), (), generator=generator))]
    emap = blank_map(resolution, WINDOW, len(stairs))
    for scan in reversed(range(_SCANS)):
        place = torch.stack([-distance - scan * _STEP, torch.zeros_like(height), height], 1)
        T_stairs_base = pose(place, yaw)
        points = _cast(pattern, stairs, T_stairs_base @ T_base_sensor, generator)
        T_map_base = T_map_stairs @ T_stairs_base
        emap.update(points, T_map_base @ T_base_sensor, T_map_base, _INTERVAL)
    return _with_truth(emap, tuple(stairs), T_map_stairs)


def _cast(
    pattern: DepthCamera | Lidar,
    stairs: Sequence[Stairs],
    T_stairs_sensor: Float[Tensor, "B 4 4"],
    generator: torch.Generator,
) -> Float[Tensor, "B M 3"]:
    clouds = [pattern.cast(each.scene, T) for each, T in zip(stairs, T_stairs_sensor, strict=True)]
    return torch.stack([noisy(cloud, generator) for cloud in clouds])


def _with_truth(emap: ElevationMap, stairs: tuple[Stairs, ...], T_map_stairs: Float[Tensor, "B 4 4"]) -> SeenStairs:
    xy = tile_cell_centers(emap, torch.linalg.inv(T_map_stairs))
    truth = torch.stack([each.scene.truth(of) for each, of in zip(stairs, xy, strict=True)])
    state = emap.state
    layers = (state.elevation, state.validity, state.variance, state.upper_bound, state.bounded, state.time)
    kinds = tuple("stairs up" if each.rise > 0 else "stairs down" for each in stairs)
    is_inside = torch.ones_like(state.validity)
    maps = TrueMap(CompletionInput(*layers), truth.float(), is_inside, emap.cfg.grid.resolution, kinds, _SCANS)
    T_center_map = torch.eye(4, dtype=torch.float64).repeat(len(stairs), 1, 1)
    T_center_map[:, :2, 3] = -emap.cell_centers().double().mean((1, 2))
    return SeenStairs(maps, stairs, T_center_map @ T_map_stairs)
