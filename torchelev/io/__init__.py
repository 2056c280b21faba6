"""Recordings: folders of scans or depth images with poses.

Files in KITTI's `.bin` and numpy's formats need numpy alone; `.ply`, `.pcd`, depth PNGs and YAML import a package where
they are read (``pip install 'torchelev[io]'``).
"""

from torchelev.io.clouds import read_cloud
from torchelev.io.depth import Intrinsics, read_depth, read_intrinsics
from torchelev.io.errors import RecordingError
from torchelev.io.layout import FileLayout
from torchelev.io.mapping import MappingRun, base_poses
from torchelev.io.poses import Poses, read_poses, read_transform
from torchelev.io.recording import Frame, Recording, open_recording

__all__ = [
    "FileLayout",
    "Frame",
    "Intrinsics",
    "MappingRun",
    "Poses",
    "Recording",
    "RecordingError",
    "base_poses",
    "open_recording",
    "read_cloud",
    "read_depth",
    "read_intrinsics",
    "read_poses",
    "read_transform",
]
