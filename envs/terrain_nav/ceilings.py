"""What TerrainNav's image shows of ceilings, as further channels: a scan of the ceiling with its mask, or voxels."""

from __future__ import annotations

from collections.abc import Callable

import torch
from torch import Tensor

from envs.terrain_nav.config import TerrainNavConfig
from torchelev import ElevationMap, HeightScan, MapImage
from torchelev.observations import VoxelCrop

Reader = Callable[[ElevationMap, Tensor], Tensor]

_FINER = 2  # voxels along a pixel
_VOXELS_HEIGHT = 1.2  # [m] of the voxels over the ground under the base


def count_channels(cfg: TerrainNavConfig) -> int:
    """Return how many channels follow the layers of the image."""
    resolution = cfg.sight.crop_resolution / _FINER
    return {"none": 0, "scan": 2, "drop": 2, "voxels": round(_VOXELS_HEIGHT / resolution)}[cfg.sight.ceilings]


def make_reader(cfg: TerrainNavConfig, crop: MapImage) -> Reader | None:
    """Return what reads the channels (B, C, n, n) from maps with levels at the crop's pixels; None for none."""
    shown = cfg.sight.ceilings
    return None if shown == "none" else _READERS[shown](cfg, crop)


def _read_scan(cfg: TerrainNavConfig, crop: MapImage) -> Reader:
    """Return the height of the ceiling over the base [m], and whether it is known."""
    points = crop.xy(torch.eye(4)[None])[0]
    scan = HeightScan.points(points, surface="ceiling", no_ceiling=cfg.sight.no_ceiling)

    def read(emap: ElevationMap, T_map_base: Tensor) -> Tensor:
        height, known = scan(emap, T_map_base)
        return torch.stack([height, known.to(height.dtype)], 1).unflatten(-1, crop.shape[1:])

    return read


def _read_drop(cfg: TerrainNavConfig, crop: MapImage) -> Reader:
    """Return how far the ceiling lies below `no_ceiling` [m], 0 where nothing hangs, and whether it is known."""
    scan = _read_scan(cfg, crop)

    def read(emap: ElevationMap, T_map_base: Tensor) -> Tensor:
        height, known = scan(emap, T_map_base).unbind(1)
        return torch.stack([cfg.sight.no_ceiling - height, known], 1)

    return read


def _read_voxels(cfg: TerrainNavConfig, crop: MapImage) -> Reader:
    """Return 1 where a voxel over the pixel is occupied, else 0: a channel for each layer of voxels, from below."""
    sight = cfg.sight
    voxels = VoxelCrop(
        length_x=sight.crop_length,
        length_y=sight.crop_length,
        length_z=_VOXELS_HEIGHT,
        resolution=sight.crop_resolution / _FINER,
        offset=(sight.crop_ahead, 0.0, _VOXELS_HEIGHT / 2 - cfg.robot.body_height),
    )

    def read(emap: ElevationMap, T_map_base: Tensor) -> Tensor:
        is_occupied = (voxels(emap, T_map_base) == 1).movedim(-1, 1).float()
        return torch.nn.functional.max_pool2d(is_occupied, _FINER)

    return read


_READERS = {"scan": _read_scan, "drop": _read_drop, "voxels": _read_voxels}
