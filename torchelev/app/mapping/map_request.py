"""The arguments of `torchelev map` and `torchelev view`."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Literal


@dataclass(frozen=True, kw_only=True)
class MapRequest:
    """Arguments of `torchelev map` as the user gave them; see its help."""

    recording: Path  #: folder of scans, or a bag
    poses: Path | None = None  #: pose file, of a bag a topic; None: found in or beside the recording
    intrinsics: Path | None = None  #: camera file of depth images; None: the scans are point clouds
    out: str = "map"  #: prefix of the output files, or a folder
    resolution: float | None = None  #: [m] cell size; None: the config's
    size: float | None = None  #: [m] side length of the map; None: the config's
    fixed: bool = False  #: keep the window in place
    levels: int | None = None  #: surfaces in each cell; None: the config's
    device: str = "cpu"  #: torch device
    config: Path | None = None  #: YAML settings
    dt: float | None = None  #: [s] between scans; None: from the pose file
    sensor_height: float | None = None  #: [m] above the base
    extrinsics: str | None = None  #: T_base_sensor, a file or numbers
    poses_of: Literal["sensor", "base"] = "sensor"  #: frame whose poses the pose file holds
    bin_layout: str | None = None  #: see FileLayout.bin
    quaternions: Literal["xyzw", "wxyz"] | None = None  #: see FileLayout.quaternions
    time_unit: Literal["s", "ms", "us", "ns"] | None = None  #: see FileLayout.time_unit
    pcd_frame: Literal["sensor", "viewpoint"] | None = None  #: see FileLayout.pcd_frame
    points: tuple[str, ...] = ()  #: topics of a bag's clouds
    depth: tuple[str, ...] = ()  #: topics of a bag's depth images
    camera_info: tuple[str, ...] = ()  #: topics of the CameraInfo of a bag's depth images
    depth_scale: float | None = None  #: [m] per unit of depth; None: the recording's, or that of the encoding
    colour: bool = False  #: fuse the colours of the points
    depth_axes: Literal["optical", "forward", "opengl"] | None = None  #: of the frame of depth images; None: optical
    semantic: str | None = None  #: topic of a bag's images of class labels
    semantic_info: str | None = None  #: topic of its CameraInfo; None: the one beside it
    classes: str | None = None  #: names of the labels 0, 1, ..., with commas between; None: numbers
    map_frame: str | None = None  #: frame of a bag in which the map is built
    base_frame: str | None = None  #: frame of a bag that the window follows
    tf: tuple[str, ...] = ()  #: topics of a bag's transforms; (): /tf and /tf_static, or those of the scans' namespace
    rays_from: str | None = None  #: frame at which the rays of registered clouds start; None: the base
    clock_offset: tuple[str, ...] = ()  #: [s] to add to the stamps of scans: S, or TOPIC=S
    stamps: Literal["header", "recorded"] = "header"  #: times of a bag's messages
    start: float | None = None  #: [s] after a bag's start; None: its start
    end: float | None = None  #: [s] after a bag's start; None: its end
    odometry: Literal["kiss-icp"] | None = None  #: finds a bag's poses from its clouds; None: it holds them
    imu: str | None = None  #: topic by which z points up, with `odometry`; None: by the ground
    save_poses: Path | None = None  #: TUM file for the poses of `odometry`
    grid_map: Path | None = None  #: bag to write the growing map to
    video: Path | None = None  #: of the growing map
    every: float | None = None  #: [s] between two maps or frames in them; None: see MapVideo, and 1 s of maps
