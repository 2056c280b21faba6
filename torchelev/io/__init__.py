"""Recordings in (scans with poses), robot models in (MJCF, URDF), maps out (export, map_file, grid_map, publish).

Plots are in `torchelev.viz`.

`.bin`, `.npy` and `.npz` files need NumPy only. `.ply`, `.pcd`, depth images and YAML need the packages of
``torchelev[io]``, and robot models need MuJoCo; these are imported on first use.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from torchelev.lazy_names import import_later

if TYPE_CHECKING:
    from torchelev.io.bags import GridMapWriter, is_bag, read_grid_map, read_grid_maps, write_grid_map
    from torchelev.io.errors import RecordingError
    from torchelev.io.files.clouds import read_cloud
    from torchelev.io.files.depth import read_depth
    from torchelev.io.files.intrinsics import Intrinsics, read_intrinsics
    from torchelev.io.files.layout import FileLayout
    from torchelev.io.folders.recording import Frame, Recording, open_recording
    from torchelev.io.labels import LabelImage
    from torchelev.io.mapping import MappingRun, base_poses
    from torchelev.io.poses import Poses, read_poses, read_transform
    from torchelev.io.robot_model import link_poses, read_body

__all__ = [
    "FileLayout",
    "Frame",
    "GridMapWriter",
    "Intrinsics",
    "LabelImage",
    "MappingRun",
    "Poses",
    "Recording",
    "RecordingError",
    "base_poses",
    "is_bag",
    "link_poses",
    "open_recording",
    "read_body",
    "read_cloud",
    "read_depth",
    "read_grid_map",
    "read_grid_maps",
    "read_intrinsics",
    "read_poses",
    "read_transform",
    "write_grid_map",
]

# Imported when first asked for: clouds of messages are read without PyTorch.
_LATER = {
    "FileLayout": "torchelev.io.files.layout",
    "Frame": "torchelev.io.folders.recording",
    "GridMapWriter": "torchelev.io.bags",
    "Intrinsics": "torchelev.io.files.intrinsics",
    "LabelImage": "torchelev.io.labels",
    "MappingRun": "torchelev.io.mapping",
    "Poses": "torchelev.io.poses",
    "Recording": "torchelev.io.folders.recording",
    "RecordingError": "torchelev.io.errors",
    "base_poses": "torchelev.io.mapping",
    "is_bag": "torchelev.io.bags",
    "link_poses": "torchelev.io.robot_model",
    "open_recording": "torchelev.io.folders.recording",
    "read_body": "torchelev.io.robot_model",
    "read_cloud": "torchelev.io.files.clouds",
    "read_depth": "torchelev.io.files.depth",
    "read_grid_map": "torchelev.io.bags",
    "read_grid_maps": "torchelev.io.bags",
    "read_intrinsics": "torchelev.io.files.intrinsics",
    "read_poses": "torchelev.io.poses",
    "read_transform": "torchelev.io.poses",
    "write_grid_map": "torchelev.io.bags",
}
__getattr__, __dir__ = import_later(__name__, _LATER)
