"""Observations for policies: height scans, map images and voxel crops. Environments are in `gym`."""

from torchelev.lazy_names import import_later

__getattr__, __dir__ = import_later(
    __name__,
    {
        "HeightScan": "torchelev.observations.height_scan",
        "MapImage": "torchelev.observations.map_image",
        "VoxelCrop": "torchelev.observations.voxel_crop",
    },
)
