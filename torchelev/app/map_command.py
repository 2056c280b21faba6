"""`torchelev map`: read a recording, fuse its scans, write and report the map."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Literal

import click
import numpy as np
from numpy.typing import NDArray

from torchelev.app.config_file import load_config
from torchelev.app.interrupts import defer_interrupts
from torchelev.app.map_files import prepare_outputs, write_outputs
from torchelev.app.report import suggest_options, summarize
from torchelev.io import FileLayout, MappingRun, Recording, RecordingError, base_poses, open_recording, read_transform

if TYPE_CHECKING:
    from torchelev.config import ElevationMapConfig
    from torchelev.elevation_map import ElevationMap

_BAD_INPUT, _INTERRUPTED = 2, 130  # exit codes


@dataclass(frozen=True, kw_only=True)
class MapRequest:
    """Arguments of `torchelev map` as the user gave them; see its help."""

    recording: Path  #: folder of scans
    poses: Path | None  #: pose file; None: found in or beside the recording
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


@dataclass(frozen=True, kw_only=True)
class MapOptions:
    """Where the robot's base is, and whether the window follows it."""

    T_base_sensor: NDArray[np.float64] | None  #: takes sensor-frame points into the base frame; None: unknown
    sensor_height: float | None  #: [m] above the base, an alternative to T_base_sensor; None: unknown
    fixed: bool  #: keep the window in place

    @property
    def knows_base(self) -> bool:
        """Whether the height of the base is known, not only the sensor's."""
        return self.T_base_sensor is not None or self.sensor_height is not None


class _UserError(click.ClickException):
    """Bad input: print one line to stderr and exit with code 2."""

    exit_code = _BAD_INPUT

    def __init__(self, error: object) -> None:
        super().__init__(" ".join(str(error).split()))


def run_map(request: MapRequest) -> int:
    """Run `torchelev map` and return its exit code; bad input becomes a one-line click error."""
    try:
        return _run(request)
    except ModuleNotFoundError as error:
        raise _UserError(f"{error}; install it with pip install 'torchelev[io]'") from error
    except (RecordingError, ValueError, OSError) as error:
        raise _UserError(error) from error


def _run(request: MapRequest) -> int:
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
    emap = new_map(load_config(request.config, request.resolution, request.size), request.device, options)
    prefix, run = prepare_outputs(request.out, emap), MappingRun(emap)
    if scans.note:
        click.echo(f"warning: {scans.note}", err=True)
    stopped = fuse_all(run, scans, options)
    return _finish(run, len(scans), prefix, stopped, options)


def _check(request: MapRequest, mount: NDArray | None) -> None:
    """Reject options that contradict each other or are out of range."""
    height, dt = request.sensor_height, request.dt
    if request.poses_of == "base" and mount is None:
        raise ValueError("--poses-of base: the sensor's pose on the robot is unknown; give --extrinsics")
    if mount is not None and height is not None:
        raise ValueError("--sensor-height: --extrinsics already gives the height; drop one of the two")
    if height is not None and not math.isfinite(height):
        raise ValueError(f"--sensor-height: must be a finite number, got {height}; give metres")
    if dt is not None and not (math.isfinite(dt) and dt >= 0):
        raise ValueError(f"--dt: must be finite and not negative, got {dt}; give seconds")


def new_map(config: ElevationMapConfig, device: str, options: MapOptions) -> ElevationMap:
    """Create an empty map; without the base's height, overlap clearance is turned off because it depends on it."""
    import torch

    from torchelev.elevation_map import ElevationMap

    if config.sensor.links:
        raise ValueError("config.sensor.body: recordings hold no poses of links; give one box, lower and upper")
    if config.sensor.body is not None and options.T_base_sensor is None:
        raise ValueError("config.sensor.body: the body box turns with the robot's base; give --extrinsics")
    if not options.knows_base:
        config = replace(config, overlap=None)
    try:
        torch.empty(1, device=device)
        return ElevationMap(config, num_envs=1, device=device)
    except (RuntimeError, AssertionError) as error:
        reason = str(error).splitlines()[0] if str(error) else type(error).__name__
        raise ValueError(f"--device {device}: {reason}; use cpu, or install a torch built for that device") from error


def fuse_all(run: MappingRun, scans: Recording, options: MapOptions) -> BaseException | None:
    """Fuse all scans in order.

    Args:
        run: the map and its counts.
        scans: the recording.
        options: where the base is, and whether the window follows it.

    Returns:
        The exception that stopped the mapping early, so that the caller can save the map before raising it; else None.
    """
    bases = base_poses(scans.T_map_sensor, options.T_base_sensor, options.sensor_height)
    sensors = scans.T_map_sensor[:, :3, 3]
    middle = (sensors.min(axis=0) + sensors.max(axis=0)) / 2
    try:
        # This update without points also covers torch's set-up on first use, which would distort the first scan's time.
        run.center_on(middle if options.fixed else bases[0, :3, 3])
        for k, frame in enumerate(_show_progress(scans)):
            with defer_interrupts():
                run.add(frame, None if options.fixed else bases[k])
    except (KeyboardInterrupt, Exception) as reason:
        return reason
    return None


def _show_progress(scans: Recording) -> Iterator:
    """Iterate with a progress bar on a terminal; print nothing where stderr is redirected."""
    from tqdm import tqdm

    yield from tqdm(scans, desc="mapping", unit="scan", disable=None, leave=False)


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
        raise _UserError(f"{stopped}; {kept}")
    if stopped is not None:
        click.echo(f"stopped by an error: {kept}", err=True)
        raise stopped
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
