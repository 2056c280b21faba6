"""The command line: a recording in, a map out."""

from __future__ import annotations

import math
import signal
import sys
import tempfile
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import click
import numpy as np
from numpy.typing import NDArray

from torchelev import __version__
from torchelev.app.report import hints, summary
from torchelev.io import FileLayout, MappingRun, Recording, RecordingError, base_poses, open_recording, read_transform
from torchelev.io.config_file import load_config
from torchelev.output_files import require_writable

if TYPE_CHECKING:
    from torchelev.config import ElevationMapConfig
    from torchelev.elevation_map import ElevationMap

BAD_INPUT, INTERRUPTED = 2, 130
SUFFIXES = (".npz", ".png", ".ply")
MESH_BYTES = 50  # per cell of a `.ply`: a vertex of 24 and two triangles of 13

MAP_HELP = """Map RECORDING, a folder of scans with poses, and write the map.

\b
RECORDING, or scans/ in it, holds one file per scan, in the order of their
names; maps that were written there before are no scans:
  .bin (KITTI: float32 x y z intensity)  .npy  .npz  .ply  .pcd
or depth images (.png, uint16 millimetres) if --intrinsics is given.
Points are in metres in the sensor's frame (x right, y down, z forward
for depth images).

\b
The pose file has one line per scan: where the sensor was, in a map
frame whose z axis points up. Either 12 numbers (KITTI: the upper 3x4 of
the pose, row by row) or 8 (TUM: t x y z qx qy qz qw). The poses that come
with KITTI odometry are the camera's, whose z axis points forward:
convert them with its calibration first.

\b
Example: a folder drive/ with scans/000000.bin ... and poses.txt
  python -m torchelev map drive
  python -m torchelev map drive/scans --poses drive/poses.txt \\
      --resolution 0.05 --size 30 --device cuda --out maps/drive

\b
--bin-layout, --quaternions, --time-unit and --pcd-frame say what files do
not: one that looks like another layout is refused.

\b
It writes PREFIX.npz (every layer and the geometry, for numpy),
PREFIX.png (a picture) and PREFIX.ply (a mesh for MeshLab, CloudCompare,
Blender). The map is a window that follows the sensor; what leaves it is
forgotten. --fixed with a larger --size keeps everything.

\b
Settings beyond these options go into a YAML, by stage, for example
  sensor: {min_distance: 0.8}    # [m] no points on the robot itself
  drift: null                    # poses do not drift in height
"""


class OneLineError(click.ClickException):
    """Bad input: one line on stderr, exit code 2."""

    exit_code = BAD_INPUT

    def __init__(self, error: object) -> None:
        super().__init__(" ".join(str(error).split()))


@dataclass(frozen=True, kw_only=True)
class MapOptions:
    """What the user asked of the map, checked."""

    #: takes sensor-frame points into the base frame; None: not given
    T_base_sensor: NDArray[np.float64] | None
    sensor_height: float | None  #: [m] of the sensor above the base, in place of T_base_sensor
    fixed: bool  #: the window stays where it is

    @property
    def knows_base(self) -> bool:
        """Whether the robot's own height is known, not only the sensor's."""
        return self.T_base_sensor is not None or self.sensor_height is not None


@click.group(context_settings={"help_option_names": ["-h", "--help"], "max_content_width": 100})
@click.version_option(__version__)
def main() -> None:
    """Elevation maps from point clouds and depth images."""


@main.command("map", help=MAP_HELP)
@click.argument("recording", type=click.Path(path_type=Path))
@click.option(
    "--poses", type=click.Path(path_type=Path), help="Pose file.  [default: poses.txt in or beside RECORDING]"
)
@click.option(
    "--intrinsics", type=click.Path(path_type=Path), help="Camera of depth images: text or YAML, fx fy cx cy."
)
@click.option(
    "--out", type=str, default="map", show_default=True, metavar="PREFIX", help="Where to write; or a folder."
)
@click.option("--resolution", type=float, metavar="M", help="Size of a cell [m].  [default: 0.1, or the config's]")
@click.option("--size", type=float, metavar="M", help="Edge of the square map [m].  [default: 20, or the config's]")
@click.option("--fixed", is_flag=True, help="Do not follow the sensor: centre the map on the middle of its path.")
@click.option("--device", default="cpu", show_default=True, help="Where to compute: cpu, cuda, cuda:1, ...")
@click.option("--config", type=click.Path(path_type=Path), help="YAML with settings of ElevationMapConfig, by stage.")
@click.option("--dt", type=float, metavar="S", help="Time between scans [s].  [default: the poses' times, or 0.1]")
@click.option("--sensor-height", type=float, metavar="M", help="The sensor's height above the robot's base [m].")
@click.option("--extrinsics", metavar="FILE|NUMBERS", help="T_base_sensor: file or quoted text, 12 numbers (3x4).")
@click.option("--poses-of", type=click.Choice(["sensor", "base"]), default="sensor", show_default=True,
              help="Whose poses the file has; 'base' needs --extrinsics.")  # fmt: skip
@click.option("--bin-layout", metavar="LAYOUT", help="Of .bin: float32x5, float64x4, ...  [default: float32x4]")
@click.option("--quaternions", type=click.Choice(["xyzw", "wxyz"]), help="Their order in a TUM file.  [default: xyzw]")
@click.option("--time-unit", type=click.Choice(["s", "ms", "us", "ns"]), help="Of a TUM file's times.  [default: s]")
@click.option("--pcd-frame", type=click.Choice(["sensor", "viewpoint"]),
              help="Frame of PCD points: the sensor's, or that in which VIEWPOINT gives its pose.")  # fmt: skip
def map_command(**options: Any) -> None:
    """Map, and turn what went wrong into one line and an exit code."""
    try:
        code = run_map(**options)
    except ModuleNotFoundError as error:
        raise OneLineError(f"{error}; install it with pip install 'torchelev[io]'") from error
    except (RecordingError, ValueError, OSError) as error:
        raise OneLineError(error) from error
    sys.exit(code)


@main.command()
@click.option("--out", type=click.Path(path_type=Path), default=Path("demo.png"), show_default=True, help="Picture.")
def demo(out: Path) -> None:
    """Simulate a walk of a robot with a depth camera, map it, and draw truth and map side by side."""
    from torchelev.app.demo import run_demo

    click.echo(run_demo(out=out, progress=True))
    click.echo(f"wrote {out}")


@main.command("filters")
def filters_command() -> None:
    """List the filters that a config can name, with their inputs and settings."""
    from torchelev.filters.registry import listing

    click.echo(listing())


def run_map(
    recording: Path,
    poses: Path | None,
    intrinsics: Path | None,
    out: str,
    resolution: float | None,
    size: float | None,
    fixed: bool,
    device: str,
    config: Path | None,
    dt: float | None,
    sensor_height: float | None,
    extrinsics: str | None,
    poses_of: str,
    bin_layout: str | None,
    quaternions: Literal["xyzw", "wxyz"] | None,
    time_unit: Literal["s", "ms", "us", "ns"] | None,
    pcd_frame: Literal["sensor", "viewpoint"] | None,
) -> int:
    """Do what `map` says; return the exit code. Raises ValueError for bad input."""
    mount = None if extrinsics is None else read_transform(extrinsics)
    check_options(mount, sensor_height, poses_of, dt)
    options = MapOptions(T_base_sensor=mount, sensor_height=sensor_height, fixed=fixed)
    layout = FileLayout(bin=bin_layout, quaternions=quaternions, time_unit=time_unit, pcd_frame=pcd_frame)
    scans = open_recording(recording, poses, intrinsics, dt, layout)
    scans = scans.moved(mount) if poses_of == "base" and mount is not None else scans
    emap = new_map(load_config(config, resolution, size), device, options)
    prefix, run = output_prefix(out, emap), MappingRun(emap)
    if scans.note:
        click.echo(f"warning: {scans.note}", err=True)
    return finish(run, len(scans), prefix, fuse_all(run, scans, options), options)


def check_options(mount: NDArray | None, sensor_height: float | None, poses_of: str, dt: float | None) -> None:
    """Refuse options that contradict each other or are no numbers."""
    if poses_of == "base" and mount is None:
        raise ValueError("--poses-of base: where the sensor sits on the robot is not known; give --extrinsics")
    if mount is not None and sensor_height is not None:
        raise ValueError("--sensor-height: --extrinsics says this already; give one of them")
    if sensor_height is not None and not math.isfinite(sensor_height):
        raise ValueError(f"--sensor-height: must be metres, got {sensor_height}")
    if dt is not None and not (math.isfinite(dt) and dt >= 0):
        raise ValueError(f"--dt: must be a time in seconds of 0 or more, got {dt}")


def new_map(config: ElevationMapConfig, device: str, options: MapOptions) -> ElevationMap:
    """One map on `device`. Overlap clearance, which needs the robot's own height, is off where that is not known."""
    import torch

    from torchelev.elevation_map import ElevationMap

    if config.sensor.body is not None and options.T_base_sensor is None:
        raise ValueError("config.sensor.body: the box turns with the robot's base, which needs --extrinsics")
    if not options.knows_base:
        config = replace(config, overlap=None)
    try:
        torch.empty(1, device=device)
        return ElevationMap(config, num_envs=1, device=device)
    except (RuntimeError, AssertionError) as error:
        reason = str(error).splitlines()[0] if str(error) else type(error).__name__
        raise ValueError(f"--device {device}: {reason}; use cpu, or a torch built for that device") from error


def output_prefix(out: str, emap: ElevationMap) -> Path:
    """PREFIX as given, less a suffix of its files, or `map` in a folder.

    Raises ValueError or WriteError now, not after hours of mapping, if a map of this size cannot be written there.
    """
    import matplotlib  # noqa: F401  # what writing needs is missed now
    import plyfile  # noqa: F401

    path = Path(out)
    prefix = path / "map" if path.is_dir() or out.endswith(("/", "\\")) else path
    prefix = prefix.with_suffix("") if prefix.suffix in SUFFIXES else prefix
    try:
        prefix.parent.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise ValueError(f"--out {out}: cannot make the folder {prefix.parent} ({error.strerror})") from error
    if prefix.exists() and not prefix.is_file():
        raise ValueError(f"--out {out}: is a device or a pipe; give a folder, or the start of a file's name")
    cells = emap.cfg.grid.height * emap.cfg.grid.width
    for path, per_cell in zip(output_paths(prefix), (4 * len(emap.layers), 0, MESH_BYTES), strict=True):
        require_writable(path, per_cell * cells)
    return prefix


def output_paths(prefix: Path) -> list[Path]:
    """PREFIX with each suffix."""
    return [prefix.with_name(prefix.name + suffix) for suffix in SUFFIXES]


def fuse_all(run: MappingRun, scans: Recording, options: MapOptions) -> BaseException | None:
    """Fuse scan after scan; return what stopped it before the end, so that what was mapped can be written first."""
    bases = base_poses(scans.T_map_sensor, options.T_base_sensor, options.sensor_height)
    sensors = scans.T_map_sensor[:, :3, 3]
    middle = (sensors.min(axis=0) + sensors.max(axis=0)) / 2
    try:
        # An update without points also pays for what torch sets up on first use, which is no scan's time.
        run.center_on(middle if options.fixed else bases[0, :3, 3])
        for k, frame in enumerate(_progress(scans)):
            with whole_scans():
                run.add(frame, None if options.fixed else bases[k])
    except (KeyboardInterrupt, Exception) as reason:
        return reason
    return None


@contextmanager
def whole_scans() -> Iterator[None]:
    """Hold a Ctrl-C back until the block is done: a scan that is fused by half is no map, nor is half a file."""
    if threading.current_thread() is not threading.main_thread():  # signals reach the main thread alone
        yield
        return
    held: list[int] = []
    before = signal.signal(signal.SIGINT, lambda number, frame: held.append(number))
    try:
        yield
    finally:
        signal.signal(signal.SIGINT, before)
    if held:
        raise KeyboardInterrupt


def _progress(scans: Recording) -> Iterator:
    """A progress bar on a terminal; nothing where stderr is a file, so that it holds errors only."""
    from tqdm import tqdm

    yield from tqdm(scans, desc="mapping", unit="scan", disable=None, leave=False)


def finish(run: MappingRun, total: int, prefix: Path, stopped: BaseException | None, options: MapOptions) -> int:
    """Write and report what there is; return the exit code, or raise what stopped the mapping."""
    kept = f"kept the map of {run.num_scans} of {total} scans" if run.num_scans else "nothing was mapped yet"
    if isinstance(stopped, Exception):
        prefix = prefix.with_name(f"{prefix.name}.partial")  # an earlier, whole map stays
    failed: list[str] = []
    if run.num_scans:
        try:
            with whole_scans():
                files, failed = write_outputs(run, prefix)
        except KeyboardInterrupt as reason:
            stopped = stopped or reason
        click.echo("\n".join(summary(run, total) + hints(run, options.fixed, options.knows_base)))
        click.echo("wrote     " + "  ".join(map(str, files)))
    for line in failed:
        click.echo(f"Error: {line}", err=True)
    if isinstance(stopped, KeyboardInterrupt):
        click.echo(f"interrupted: {kept}", err=True)
        return INTERRUPTED
    if isinstance(stopped, RecordingError | OSError):
        raise OneLineError(f"{stopped}; {kept}")
    if stopped is not None:
        click.echo(f"stopped by an error: {kept}", err=True)
        raise stopped
    if failed:
        return BAD_INPUT
    for line in run.emap.diagnose():
        click.echo(f"warning: {line}", err=True)
    return 0


def write_outputs(run: MappingRun, prefix: Path) -> tuple[list[Path], list[str]]:
    """Write the map's `.npz`, `.png` and `.ply`, where one fails in another folder; return paths, and what failed."""
    from torchelev.io import export

    writers = (lambda path: export.save_npz(path, run.emap), lambda path: save_picture(path, run, prefix.name),
               lambda path: export.save_mesh(path, run.emap))  # fmt: skip
    files, failed = [], []
    for path, write in zip(output_paths(prefix), writers, strict=True):
        try:
            write(path)
            files.append(path)
        except (OSError, ModuleNotFoundError) as error:  # one that fails must not take the others with it
            kept = keep_elsewhere(path.name, write) if isinstance(error, OSError) else None
            files += [] if kept is None else [kept]
            failed.append(f"{error}; " + ("not kept" if kept is None else f"kept in {kept}"))
    return files, failed


def keep_elsewhere(name: str, write: Callable[[Path], object]) -> Path | None:
    """Write a file into the first of the usual folders that takes it; return its path, None if none does."""
    for base in (Path(tempfile.gettempdir()), Path.cwd(), Path.home(), Path("/dev/shm")):
        try:
            folder = Path(tempfile.mkdtemp(prefix="torchelev-", dir=base))
        except OSError:
            continue
        try:
            write(folder / name)
            return folder / name
        except OSError:
            folder.rmdir()
    return None


def save_picture(path: Path, run: MappingRun, title: str) -> None:
    """Draw the layers that tell most, and the sensor's path."""
    from torchelev.app.report import map_panels
    from torchelev.io import export
    from torchelev.viz.plot import save_layers

    saved = export.take(run.emap)
    panels = map_panels(saved.layers, tuple(run.emap.filters.inputs))
    save_layers(path, panels, extent=saved.extent, path_xy=np.array(run.sensor_xy), title=title)
