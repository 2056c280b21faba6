"""Voxels around the robots, for policies that pass below ceilings, through doors and over bridges."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

import torch
from torch import Tensor

from torchelev.elevation_map import ElevationMap
from torchelev.errors import require, require_positive, whole_cells
from torchelev.layers import containing_cells
from torchelev.levels.module import MapLevels
from torchelev.observations import patterns, voxel_kernel
from torchelev.observations.inputs import check_base
from torchelev.observations.patterns import Pattern
from torchelev.state import MapState

if TYPE_CHECKING:
    from jaxtyping import Float, UInt8

FREE, OCCUPIED, UNKNOWN = 0, 1, 2
VALUES = ("states", "distances")


@dataclass(frozen=True, kw_only=True)
class VoxelCrop:
    """Read what is around the base as voxels (B, X, Y, Z), of maps with levels.

    X = length_x / resolution, likewise Y and Z; the centre of voxel [i, j, k] is at offset + (i + 0.5 - X / 2, j + 0.5
    - Y / 2, k + 0.5 - Z / 2) * resolution. The crop turns with the heading of the base; its z axis stays vertical. The
    defaults are the 32 x 32 x 40 voxels of 5 cm of Gallant (arXiv 2511.14625).

    "states" are uint8. Each column is read in the cell that holds its centre:

    - 1, occupied: its centre lies below the ground, or it meets another surface
    - 0, free: its centre lies above the ground, or above the upper bound of ground that is not known, and below the
      lowest surface above, or where there is none, as high as rays over the cell show it
    - 2, unknown: else, and outside the map's window

    "distances" are float32 [m]: from the centre of a free or unknown voxel to that of the nearest occupied one, and
    negative from an occupied one to the nearest other one; at most `max_distance`.

    Raises:
        ValueError: for a setting out of range.
    """

    length_x: float = 1.6  #: [m] along x, a whole number of voxels
    length_y: float = 1.6  #: [m] along y, a whole number of voxels
    length_z: float = 2.0  #: [m] along z, a whole number of voxels
    resolution: float = 0.05  #: [m] side of a voxel
    offset: tuple[float, float, float] = (0.0, 0.0, 0.0)  #: [m] centre of the crop from the base, in its heading
    values: str = "states"  #: "states" or "distances"
    max_distance: float = 0.5  #: [m] at which distances are cut off
    #: "yaw" turns the crop with the base's heading; "world" only moves it
    alignment: str = "yaw"
    _size: tuple[int, int, int] = field(init=False, repr=False, compare=False)
    _pattern: Pattern = field(init=False, repr=False, compare=False)

    def __post_init__(self) -> None:
        X, Y, Z = (whole_cells(f"length_{axis}", getattr(self, f"length_{axis}"), self.resolution) for axis in "xyz")
        known, rule = self.values in VALUES, f"must be one of {', '.join(VALUES)}"
        require(known, "values", rule, repr(self.values), "check its spelling")
        require_positive(max_distance=self.max_distance)
        known = self.alignment in ("yaw", "world")
        require(known, "alignment", "must be yaw or world", repr(self.alignment), "use yaw")
        is_place = len(self.offset) == 3 and all(math.isfinite(value) for value in self.offset)
        require(is_place, "offset", "must be three finite numbers", repr(self.offset), "give x, y and z [m]")
        x, y = (
            patterns.space_around(middle, n, self.resolution) for middle, n in zip(self.offset[:2], (X, Y), strict=True)
        )
        points = patterns.parse_points(patterns.order_y_fastest(x, y))
        object.__setattr__(self, "_size", (X, Y, Z))
        object.__setattr__(self, "_pattern", Pattern(points, self.alignment))

    @property
    def shape(self) -> tuple[int, int, int]:
        """(X, Y, Z), for the policy's input layer."""
        return self._size

    def __call__(
        self, emap: ElevationMap, T_map_base: Float[Tensor, "B 4 4"], *, state: MapState | None = None
    ) -> Tensor:
        """Read the voxels around the base of each environment, as a fresh tensor. They have no gradients.

        Args:
            emap: the maps.
            T_map_base: base poses, in float64 far from the origin.
            state: the state of which the ground is read; None: that of the maps.

        Raises:
            ValueError, TypeError: for a wrong shape, dtype or device, a window too small for the crop, or maps without
                levels.
        """
        hint = "give the map's config levels=LevelsConfig()"
        require(emap.levels is not None, "emap", "must be maps with levels", f"cfg.levels = {emap.cfg.levels}", hint)
        assert emap.levels is not None
        self._pattern.require_inside(emap.cfg.grid)
        T_map_base = check_base(emap, T_map_base)
        current = emap.state if state is None else state
        with torch.no_grad():
            states = self._read_states(emap.levels, T_map_base, current, state is None)
            return states if self.values == "states" else self._measure_distances(states)

    def _read_states(
        self, levels: MapLevels, T_map_base: Tensor, state: MapState, is_own: bool
    ) -> UInt8[Tensor, "B X Y Z"]:
        X, Y, Z = self._size
        if is_own and voxel_kernel.can_read(T_map_base, state, levels):
            given = (T_map_base, state, levels, self._pattern, Z, self.resolution, self.offset[2])
            return voxel_kernel.read_voxels(*given).view(-1, X, Y, Z)
        return self._read_in_torch(levels, T_map_base, state).view(-1, X, Y, Z)

    def _read_in_torch(self, levels: MapLevels, T_map_base: Tensor, state: MapState) -> UInt8[Tensor, "B P Z"]:
        """Read states by tensors: this is the definition."""
        surfaces, grid, Z = levels.view(state), levels.cfg.grid, self._size[2]
        dtype = surfaces.lower.dtype
        origin = T_map_base[:, None, :3, 3]
        is_finite = torch.isfinite(origin).all(-1, keepdim=True)
        uv = self._pattern.place(T_map_base, origin, state.corner, grid.resolution, dtype)
        cell, inside = containing_cells(uv, grid)
        rise = self.offset[2] + (torch.arange(Z, device=uv.device, dtype=dtype) + 0.5 - 0.5 * Z) * self.resolution
        middle = T_map_base[:, 2, 3, None].to(dtype) + rise
        bottom, middle, top = (
            z[:, None] for z in (middle - 0.5 * self.resolution, middle, middle + 0.5 * self.resolution)
        )

        def read(layer: Tensor) -> Tensor:
            return layer.flatten(1).gather(1, cell)[..., None]

        floor, known, has_floor = read(surfaces.floor), read(surfaces.known[:, 0]), read(surfaces.has_floor)
        others = [[read(layer[:, k]) for layer in surfaces[:2]] for k in range(1, surfaces.lower.shape[1])]
        exists = [read(surfaces.known[:, k]) for k in range(1, surfaces.lower.shape[1])]
        limit = torch.full_like(floor, torch.inf)
        for (lower, _), there in zip(others, exists, strict=True):
            limit = torch.where(there & (lower > floor) & (lower < limit), lower, limit)
        limit = torch.where(torch.isinf(limit), read(surfaces.free_top), limit)
        occupied = known & (middle < floor)
        for (lower, upper), there in zip(others, exists, strict=True):
            occupied = occupied | (there & (bottom <= upper) & (top > lower))
        is_free = has_floor & (middle >= floor) & (middle <= limit)
        states = torch.where(occupied, OCCUPIED, torch.where(is_free, FREE, UNKNOWN))
        return torch.where((inside & is_finite[..., 0])[..., None], states, UNKNOWN).to(torch.uint8)

    def _measure_distances(self, states: UInt8[Tensor, "B X Y Z"]) -> Float[Tensor, "B X Y Z"]:
        """Return the signed distances, from squared distances axis by axis (Felzenszwalb and Huttenlocher, 2012)."""
        reach = math.ceil(self.max_distance / self.resolution)
        if voxel_kernel.can_measure(states):
            return voxel_kernel.measure_distances(states, OCCUPIED, reach, self.resolution, self.max_distance)
        occupied = states == OCCUPIED
        to_occupied, to_other = (_nearest(mask, reach) for mask in (occupied, ~occupied))
        distance = torch.where(occupied, -to_other, to_occupied) * self.resolution
        return distance.clamp(-self.max_distance, self.max_distance)


def _nearest(mask: Tensor, reach: int) -> Float[Tensor, "B X Y Z"]:
    """Return the distance to the nearest true voxel [voxels], infinite beyond `reach` along an axis."""
    square = torch.where(mask, 0.0, torch.inf)
    for axis in (1, 2, 3):
        best = square.clone()
        for k in range(1, min(reach, square.shape[axis] - 1) + 1):
            size = square.shape[axis] - k
            ahead, behind = best.narrow(axis, 0, size), best.narrow(axis, k, size)
            ahead.copy_(torch.minimum(ahead, square.narrow(axis, k, size) + k * k))
            behind.copy_(torch.minimum(behind, square.narrow(axis, 0, size) + k * k))
        square = best
    return square.sqrt()
