"""Open the scans that a request names: a folder of files, or a bag."""

from __future__ import annotations

import math
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING

import click
from numpy.typing import NDArray

from torchelev.app.mapping.fuse_scans import MapOptions, Scans, show_progress
from torchelev.app.mapping.map_channels import require_colors, wanted_channels
from torchelev.app.mapping.map_request import MapRequest
from torchelev.io import FileLayout, Recording, base_poses, is_bag, open_recording, read_transform

if TYPE_CHECKING:
    from torchelev.io.bags import BagRecording, BagRequest

_PLAIN = MapRequest(recording=Path())
_ONLY_BAGS = (
    "points", "depth", "camera_info", "map_frame", "base_frame", "tf", "rays_from", "clock_offset", "stamps",
    "start", "end", "odometry", "imu", "save_poses", "semantic", "semantic_info", "classes",
)  # fmt: skip
_ONLY_FOLDERS = (
    "intrinsics", "dt", "sensor_height", "bin_layout", "quaternions", "time_unit", "pcd_frame", "poses_of",
)  # fmt: skip


@contextmanager
def open_scans(request: MapRequest) -> Iterator[tuple[Scans, MapOptions]]:
    """Open the scans of a request, and print warnings: of a folder before they are read, of a bag afterwards.

    Raises:
        RecordingError: the recording cannot be read.
        ValueError: options contradict each other, or are out of range.
    """
    if is_bag(request.recording):
        with _open_bag(request) as opened:
            yield opened
    else:
        scans, options = _open_folder(request)
        try:
            yield scans, options
        finally:
            for note, number in scans.notes.items():
                click.echo(f"warning: {note}" + (f" (and {number - 1} more scans)" if number > 1 else ""), err=True)


def _open_folder(request: MapRequest) -> tuple[Recording, MapOptions]:
    mount = None if request.extrinsics is None else read_transform(request.extrinsics)
    _check(request, mount)
    scans = _open_files(request)
    if request.poses_of == "base" and mount is not None:
        scans = scans.apply_mount(mount)
    scans = scans.with_bases(base_poses(scans.T_map_sensor, mount, request.sensor_height))
    if request.colour:
        require_colors(scans)
    if scans.note:
        click.echo(f"warning: {scans.note}", err=True)
    return scans, MapOptions(
        T_base_sensor=mount,
        sensor_height=request.sensor_height,
        fixed=request.fixed,
        levels=request.levels,
        channels=wanted_channels(request.colour),
    )


def _open_files(request: MapRequest) -> Recording:
    layout = FileLayout(
        bin=request.bin_layout,
        quaternions=request.quaternions,
        time_unit=request.time_unit,
        pcd_frame=request.pcd_frame,
    )
    return open_recording(
        request.recording,
        request.poses,
        request.intrinsics,
        request.dt,
        layout,
        request.depth_scale,
        request.depth_axes,
    )


def _check(request: MapRequest, mount: NDArray | None) -> None:
    """Reject options that contradict each other or are out of range."""
    height, dt = request.sensor_height, request.dt
    given = [f"--{name.replace('_', '-')}" for name in _ONLY_BAGS if getattr(request, name) != getattr(_PLAIN, name)]
    if given:
        raise ValueError(f"{', '.join(given)}: for bags only, and {request.recording} is not a bag")
    if request.poses_of == "base" and mount is None:
        raise ValueError("--poses-of base: the sensor's pose on the robot is unknown; give --extrinsics")
    if mount is not None and height is not None:
        raise ValueError("--sensor-height: --extrinsics already gives the height; drop one of the two")
    if height is not None and not math.isfinite(height):
        raise ValueError(f"--sensor-height: must be a finite number, got {height}; give metres")
    if dt is not None and not (math.isfinite(dt) and dt >= 0):
        raise ValueError(f"--dt: must be finite and not negative, got {dt}; give seconds")


@contextmanager
def _open_bag(request: MapRequest) -> Iterator[tuple[Scans, MapOptions]]:
    from torchelev.io.bags import Bag, open_bag
    from torchelev.io.bags.topics import describe_unread

    _refuse_file_options(request)
    _require_odometry(request)
    _require_semantic(request)
    with Bag(request.recording) as bag:
        scans = open_bag(bag, _to_bag_request(request), lambda m: show_progress(m, "reading poses", "message"))
        if bag.unread:
            click.echo(f"not read  {describe_unread(bag)}")
        rays = f", rays from {scans.rays_from}" if scans.rays_from else ""
        click.echo(f"mapping   {', '.join(scans.topics)} in {scans.map_frame}, around {scans.base_frame}{rays}")
        if request.save_poses is not None:
            _save_poses(request.save_poses, scans)
        printed = list(scans.pose_notes)
        _warn(printed)
        num_classes = None if scans.labels is None else scans.labels.num_classes
        options = MapOptions(
            T_base_sensor=None,
            sensor_height=None,
            fixed=request.fixed,
            levels=request.levels,
            has_base=scans.has_base,
            channels=wanted_channels(request.colour, num_classes, _class_names(request)),
        )
        try:
            yield scans, options
        finally:
            _warn([note for note in scans.warnings if note not in printed])


def _require_odometry(request: MapRequest) -> None:
    """Refuse options that only --odometry reads."""
    for name in ("imu", "save_poses"):
        if getattr(request, name) is not None and request.odometry is None:
            raise ValueError(f"--{name.replace('_', '-')}: only with --odometry; give --odometry kiss-icp")


def _require_semantic(request: MapRequest) -> None:
    """Refuse options that only --semantic reads, and invalid names of classes."""
    for name in ("semantic_info", "classes"):
        if getattr(request, name) is not None and request.semantic is None:
            raise ValueError(f"--{name.replace('_', '-')}: only with --semantic; give --semantic TOPIC")
    names = _class_names(request)
    if request.classes is not None and (len(names) < 2 or not all(names)):
        raise ValueError(f"--classes {request.classes}: must name two classes or more; give grass,stone")


def _class_names(request: MapRequest) -> tuple[str, ...]:
    return () if request.classes is None else tuple(name.strip() for name in request.classes.split(","))


def _save_poses(path: Path, scans: BagRecording) -> None:
    from torchelev.io.bags.poses.rows import from_matrix
    from torchelev.io.odometry import write_tum

    stamps, poses, sensor = scans.odometry_poses()
    about = f"pose of {sensor} in {scans.map_frame}, z up, at the stamps of the scans [s]; by KISS-ICP"
    write_tum(path, stamps, map(from_matrix, poses), about)
    click.echo(f"poses     {path}: {len(stamps)} of {sensor} in {scans.map_frame}")


def _warn(notes: list[str]) -> None:
    for note in notes:
        click.echo(f"warning: {note}", err=True)


def _to_bag_request(request: MapRequest) -> BagRequest:
    from torchelev.io.bags import BagRequest

    return BagRequest(
        clouds=request.points,
        depths=request.depth,
        map_frame=request.map_frame,
        base_frame=request.base_frame,
        poses=None if request.poses is None else str(request.poses),
        camera_infos=request.camera_info,
        depth_scale=request.depth_scale,
        depth_axes=request.depth_axes or "optical",
        transforms=request.tf,
        T_base_sensor=None if request.extrinsics is None else read_transform(request.extrinsics),
        rays_from=request.rays_from,
        clock_offsets=dict(_read_offset(text) for text in request.clock_offset),
        stamps=request.stamps,
        start=request.start,
        end=request.end,
        odometry=request.odometry,
        imu=request.imu,
        colors=request.colour,
        semantic=request.semantic,
        semantic_info=request.semantic_info,
        classes=_class_names(request),
    )


def _read_offset(text: str) -> tuple[str, float]:
    """Return the topic, "" for all, and the offset [s] of `--clock-offset`."""
    topic, _, number = text.rpartition("=")
    try:
        offset = float(number)
    except ValueError:
        offset = math.nan
    if not math.isfinite(offset):
        raise ValueError(f"--clock-offset {text}: must be a number of seconds, or TOPIC=SECONDS")
    return topic, offset


def _refuse_file_options(request: MapRequest) -> None:
    """Reject options for what a bag itself holds."""
    given = [f"--{name.replace('_', '-')}" for name in _ONLY_FOLDERS if getattr(request, name) != getattr(_PLAIN, name)]
    if given:
        raise ValueError(
            f"{', '.join(given)}: for folders of files only, and {request.recording} is a bag, which holds this itself"
        )
