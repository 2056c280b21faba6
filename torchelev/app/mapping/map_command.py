"""`torchelev map`: read a recording, fuse its scans, write and report the map."""

from __future__ import annotations

from pathlib import Path

import click

from torchelev.app.config_file import load_config
from torchelev.app.interrupts import defer_interrupts
from torchelev.app.mapping.fuse_scans import MapOptions, Scans, fuse_all, new_map
from torchelev.app.mapping.map_files import prepare_outputs, write_outputs
from torchelev.app.mapping.map_recorder import MapRecorder
from torchelev.app.mapping.map_request import MapRequest
from torchelev.app.mapping.map_video import MapVideo
from torchelev.app.mapping.open_scans import open_scans
from torchelev.app.mapping.report import describe_emptiness, suggest_options, summarize
from torchelev.app.user_error import BAD_INPUT, EmptyMapError, UserError, user_errors
from torchelev.io import Frame, MappingRun, RecordingError, is_bag

_INTERRUPTED = 130  # exit code
_DEFAULT_EVERY = 1.0  # [s] between two maps of --grid-map


def run_map(request: MapRequest) -> int:
    """Run `torchelev map` and return its exit code; bad input becomes a one-line click error."""
    with user_errors(), open_scans(request) as (scans, options):
        return map_scans(request, scans, options)


def map_scans(request: MapRequest, scans: Scans, options: MapOptions) -> int:
    """Fuse all scans of a recording, write the map, report it and return the exit code."""
    emap = new_map(load_config(request.config, request.resolution, request.size), request.device, options)
    prefix, run = prepare_outputs(request.out, emap), MappingRun(emap)
    every = request.every
    _check_recordings(request)
    video = MapVideo(request.video, every, len(scans), request.recording.resolve().name)
    frame = getattr(scans, "map_frame", "map")
    recorder = MapRecorder(request.grid_map, _DEFAULT_EVERY if every is None else every, frame)
    stopped = _fuse_and_record(run, scans, options, recorder, video)
    if recorder.num:
        click.echo(f"recorded  {recorder.num} map{'s' * (recorder.num != 1)} in {recorder.path}")
    if video.num:
        click.echo(f"filmed    {video.num} frames in {video.path}")
    return _finish(run, len(scans), prefix, stopped, options)


def _check_recordings(request: MapRequest) -> None:
    """Refuse to record the map over the recording, and an interval between maps that is invalid or unused."""
    every, recording = request.every, request.recording.resolve()
    for name, path in (("--grid-map", request.grid_map), ("--video", request.video)):
        if path is not None and recording in (path.resolve(), *(path.resolve().parents if is_bag(recording) else ())):
            raise ValueError(f"{name}: must not be written over the recording, got {path}; choose another path")
    if every is not None and not every >= 0:
        raise ValueError(f"--every: must not be negative, got {every}; give seconds, or 0 for each scan")
    if every is not None and request.grid_map is None and request.video is None:
        raise ValueError("--every: says how often the map is recorded; give --grid-map or --video, too")


def _fuse_and_record(
    run: MappingRun, scans: Scans, options: MapOptions, recorder: MapRecorder, video: MapVideo
) -> BaseException | None:
    """Fuse all scans and record the growing map; return the error that stopped it, if any."""

    def after(run: MappingRun, frame: Frame) -> None:
        recorder.after(run, frame)
        video.after(run, frame)

    try:
        with recorder, video:
            return fuse_all(run, scans, options, after)
    except (KeyboardInterrupt, OSError) as reason:  # raised when a recording is finished: the map is still written
        return reason


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
        return BAD_INPUT
    for line in run.emap.diagnose():
        click.echo(f"warning: {line}", err=True)
    emptiness = describe_emptiness(run)
    if emptiness:
        raise EmptyMapError(emptiness)
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
