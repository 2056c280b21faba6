"""`torchelev map`: read a recording, fuse its scans, write and report the map."""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import click
from numpy.typing import NDArray

from torchelev.app.config_file import load_config
from torchelev.app.fuse_scans import MapOptions, Scans, fuse_all, new_map, show_progress
from torchelev.app.interrupts import defer_interrupts
from torchelev.app.map_files import prepare_outputs, write_outputs
from torchelev.app.map_recorder import MapRecorder
from torchelev.app.map_video import MapVideo
from torchelev.app.report import suggest_options, summarize
from torchelev.io import (
    FileLayout,
    Frame,
    MappingRun,
    RecordingError,
    base_poses,
    is_bag,
    open_recording,
    read_transform,
)

_BAD_INPUT, _INTERRUPTED = 2, 130  # exit codes
_DEFAULT_EVERY = 1.0  # [s] between two maps of --grid-map


@dataclass(frozen=True, kw_only=True)
class MapRequest:
    """Arguments of `torchelev map` as the user gave them; see its help."""

    recording: Path  #: folder of scans, or a bag
    poses: Path | None  #: pose file, of a bag a topic; None: found in or beside the recording
    intrinsics: Path | None  #: camera file of depth images; None: the scans are point clouds
    out: str  #: prefix of the output files, or a folder
    resolution: float | None  #: [m] cell size; None: the config's
    size: float | None  #: [m] side length of the map; None: the config's
    fixed: bool  #: keep the window in place
    device: str  #: torch device
    config: Path | None  #: YAML settings
    dt: float | None  #: [s] between scans; None: from the pose file
    sensor_height: float | None  #: [m] above the base
    extrinsics: str | None  #: T_base_sensor, a file or numbers
    poses_of: Literal["sensor", "base"]  #: frame whose poses the pose file holds
    bin_layout: str | None  #: see FileLayout.bin
    quaternions: Literal["xyzw", "wxyz"] | None  #: see FileLayout.quaternions
    time_unit: Literal["s", "ms", "us", "ns"] | None  #: see FileLayout.time_unit
    pcd_frame: Literal["sensor", "viewpoint"] | None  #: see FileLayout.pcd_frame
    points: tuple[str, ...] = ()  #: topics of a bag's clouds
    depth: tuple[str, ...] = ()  #: topics of a bag's depth images
    map_frame: str | None = None  #: frame of a bag in which the map is built
    base_frame: str | None = None  #: frame of a bag that the window follows
    grid_map: Path | None = None  #: bag to write the growing map to
    video: Path | None = None  #: of the growing map
    every: float | None = None  #: [s] between two maps or frames in them; None: see MapVideo, and 1 s of maps


class UserError(click.ClickException):
    """Bad input: print one line to stderr and exit with code 2."""

    exit_code = _BAD_INPUT

    def __init__(self, error: object) -> None:
        super().__init__(" ".join(str(error).split()))


def run_map(request: MapRequest) -> int:
    """Run `torchelev map` and return its exit code; bad input becomes a one-line click error."""
    try:
        return _run(request)
    except ModuleNotFoundError as error:
        extra = {"rosbags": "bags", "mcap": "bags", "av": "video"}.get(str(error.name).split(".")[0], "io")
        raise UserError(f"{error}; install it with pip install 'torchelev[{extra}]'") from error
    except (RecordingError, ValueError, OSError) as error:
        raise UserError(error) from error


def _run(request: MapRequest) -> int:
    if is_bag(request.recording):
        return run_bag(request)
    mount = None if request.extrinsics is None else read_transform(request.extrinsics)
    _check(request, mount)
    options = MapOptions(T_base_sensor=mount, sensor_height=request.sensor_height, fixed=request.fixed)
    layout = FileLayout(
        bin=request.bin_layout,
        quaternions=request.quaternions,
        time_unit=request.time_unit,
        pcd_frame=request.pcd_frame,
    )
    scans = open_recording(request.recording, request.poses, request.intrinsics, request.dt, layout)
    if request.poses_of == "base" and mount is not None:
        scans = scans.apply_mount(mount)
    scans = scans.with_bases(base_poses(scans.T_map_sensor, mount, request.sensor_height))
    if scans.note:
        click.echo(f"warning: {scans.note}", err=True)
    return map_scans(request, scans, options)


def map_scans(request: MapRequest, scans: Scans, options: MapOptions) -> int:
    """Fuse all scans of a recording, write the map, report it and return the exit code."""
    emap = new_map(load_config(request.config, request.resolution, request.size), request.device, options)
    prefix, run = prepare_outputs(request.out, emap), MappingRun(emap)
    every = request.every
    if every is not None and not every >= 0:
        raise ValueError(f"--every: must not be negative, got {every}; give seconds, or 0 for each scan")
    video = MapVideo(request.video, every, len(scans), request.recording.resolve().name)
    frame = getattr(scans, "map_frame", "map")
    recorder = MapRecorder(request.grid_map, _DEFAULT_EVERY if every is None else every, frame)
    stopped = _fuse_and_record(run, scans, options, recorder, video)
    if recorder.num:
        click.echo(f"recorded  {recorder.num} maps in {recorder.path}")
    if video.num:
        click.echo(f"filmed    {video.num} frames in {video.path}")
    return _finish(run, len(scans), prefix, stopped, options)


def _fuse_and_record(
    run: MappingRun, scans: Scans, options: MapOptions, recorder: MapRecorder, video: MapVideo
) -> BaseException | None:
    """Fuse all scans and record the growing map; return what stopped that, if anything did."""

    def after(run: MappingRun, frame: Frame) -> None:
        recorder.after(run, frame)
        video.after(run, frame)

    try:
        with recorder, video:
            return fuse_all(run, scans, options, after)
    except (KeyboardInterrupt, OSError) as reason:  # raised when a recording is finished: the map is still written
        return reason


def _check(request: MapRequest, mount: NDArray | None) -> None:
    """Reject options that contradict each other or are out of range."""
    height, dt = request.sensor_height, request.dt
    names = ("points", "depth", "map_frame", "base_frame")
    given = [f"--{name.replace('_', '-')}" for name in names if getattr(request, name)]
    if given:
        raise ValueError(f"{', '.join(given)}: only bags have topics and frames, and {request.recording} is none")
    if request.poses_of == "base" and mount is None:
        raise ValueError("--poses-of base: the sensor's pose on the robot is unknown; give --extrinsics")
    if mount is not None and height is not None:
        raise ValueError("--sensor-height: --extrinsics already gives the height; drop one of the two")
    if height is not None and not math.isfinite(height):
        raise ValueError(f"--sensor-height: must be a finite number, got {height}; give metres")
    if dt is not None and not (math.isfinite(dt) and dt >= 0):
        raise ValueError(f"--dt: must be finite and not negative, got {dt}; give seconds")


def run_bag(request: MapRequest) -> int:
    """Map the scans of a bag, and say what was left out."""
    from torchelev.io.bags import Bag, BagRequest, open_bag

    _refuse_file_options(request)
    poses = None if request.poses is None else str(request.poses)
    wanted = BagRequest(request.points, request.depth, request.map_frame, request.base_frame, poses)
    with Bag(request.recording) as bag:
        scans = open_bag(bag, wanted, lambda m: show_progress(m, "reading poses", "message"))
        click.echo(f"mapping   {', '.join(scans.topics)} in {scans.map_frame}, around {scans.base_frame}")
        options = MapOptions(T_base_sensor=None, sensor_height=None, fixed=request.fixed, has_base=scans.has_base)
        try:
            return map_scans(request, scans, options)
        finally:
            for note in scans.warnings:
                click.echo(f"warning: {note}", err=True)


def _refuse_file_options(request: MapRequest) -> None:
    """Reject options for what a bag itself says."""
    names = ("intrinsics", "dt", "sensor_height", "extrinsics", "bin_layout", "quaternions", "time_unit", "pcd_frame")
    given = [f"--{name.replace('_', '-')}" for name in names if getattr(request, name) is not None]
    if given or request.poses_of == "base":
        given = given or ["--poses-of"]
        raise ValueError(
            f"{', '.join(given)}: only for folders of files; {request.recording} is a bag, which says it itself"
        )


def _finish(run: MappingRun, num_scans: int, prefix: Path, stopped: BaseException | None, options: MapOptions) -> int:
    """Write and report the map; return the exit code, or raise what stopped the mapping."""
    kept = f"kept the map of {run.num_scans} of {num_scans} scans" if run.num_scans else "nothing was mapped yet"
    if isinstance(stopped, Exception):
        prefix = prefix.with_name(f"{prefix.name}.partial")  # do not replace an earlier, complete map
    failures, interrupt = _write_and_report(run, num_scans, prefix, options) if run.num_scans else ([], None)
    stopped = stopped or interrupt
    if isinstance(stopped, KeyboardInterrupt):
        click.echo(f"interrupted: {kept}", err=True)
        return _INTERRUPTED
    if isinstance(stopped, RecordingError | OSError):
        raise UserError(f"{stopped}; {kept}")
    if stopped is not None:
        click.echo(f"stopped by an error: {kept}", err=True)
        raise stopped
    if not run.num_scans:
        raise UserError(f"none of the {num_scans} scans could be used")
    if failures:
        return _BAD_INPUT
    for line in run.emap.diagnose():
        click.echo(f"warning: {line}", err=True)
    return 0


def _write_and_report(
    run: MappingRun, num_scans: int, prefix: Path, options: MapOptions
) -> tuple[list[str], KeyboardInterrupt | None]:
    """Write the map's files and print a summary; return errors, and a Ctrl-C pressed while writing."""
    interrupt = None
    try:
        with defer_interrupts():
            files, failures = write_outputs(run, prefix)
    except KeyboardInterrupt as reason:
        interrupt = reason
    click.echo("\n".join(summarize(run, num_scans) + suggest_options(run, options.fixed, options.knows_base)))
    click.echo("wrote     " + "  ".join(map(str, files)))
    for line in failures:
        click.echo(f"Error: {line}", err=True)
    return failures, interrupt
