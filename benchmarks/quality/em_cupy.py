"""How near the maps of `ElevationMapConfig.like_em_cupy` come to what elevation_mapping_cupy's own code computed.

    make quality-em-cupy GOLDENS=<folder>

The folder holds what that package's kernels computed on scenes, frame by frame, and between which values other orders
of the points and rays would have ended: `<scene>.inputs.npz` with the clouds and poses and `<scene>.f32.npz` with the
maps. It is not part of the repository. One step starts from the recorded map before it; a whole run starts from a blank
one. A cell agrees if it lies between those values: validity, and time to 1 ms; elevation to 1 cm, variance to 0.01 m^2,
and the upper bound of unknown cells to 1 cm. Shares are the lowest of all frames. Writes
benchmarks/results/em_cupy.json.
"""

from __future__ import annotations

import argparse
import json
import statistics
import time
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from benchmarks import RESULTS
from benchmarks.quality.em_cupy_channels import channels_table, evaluate_channels
from benchmarks.speed.common.workload import BPEARL, Drive, full_config
from torchelev import ElevationMap, ElevationMapConfig
from torchelev.app.results import markdown_table, write_json
from torchelev.stages.like_em_cupy import DEFAULTS
from torchelev.state import MapState

LAYERS = ("elevation", "variance", "is_valid", "traversability", "time", "upper_bound", "is_upper_bound")
TOLERANCES = {"elevation": 0.01, "variance": 0.01, "time": 1e-3, "upper_bound": 0.01}
COLUMNS = ("validity", "time", "elevation", "variance", "upper_bound")
Array = NDArray[Any]


class Scene:
    """One recorded scene, and a map that is updated as it was."""

    def __init__(self, folder: Path, name: str, weights: Path | None) -> None:
        self.inputs, self.maps = (dict(np.load(folder / f"{name}.{kind}.npz")) for kind in ("inputs", "f32"))
        self.parameters = json.loads(str(self.inputs["param_json"]))
        known = {key: value for key, value in self.parameters.items() if key in DEFAULTS}
        self.emap = ElevationMap(ElevationMapConfig.like_em_cupy(weights=weights, **known))
        self.starts = np.concatenate([[0], np.cumsum(self.inputs["npts"])])
        self.frames = len(self.inputs["npts"])

    def update(self, f: int) -> None:
        """Take in frame f."""
        T, base = np.eye(4), np.eye(4)
        T[:3, :3], T[:3, 3], base[:3, 3] = self.inputs["R"][f], self.inputs["t"][f], self.inputs["move_to"][f]
        points = self.inputs["points"][self.starts[f] : self.starts[f + 1]]
        moved = ("position", "orientation")
        moving = any(self.inputs[f"{name}_noise"][f] > self.parameters[f"{name}_noise_thresh"] for name in moved)
        poses = (torch.from_numpy(pose[None]) for pose in (T, base))
        seconds = float(self.inputs["n_update_time"][f]) * self.parameters["time_interval"]
        self.emap.update(torch.from_numpy(points[None]), *poses, dt=seconds, moving=bool(moving))

    def load(self, f: int) -> None:
        """Start from the recorded map after frame f."""
        inner = slice(1, -1)
        layer = {name: self.maps[f"map_{f:02d}"][k, inner, inner] for k, name in enumerate(LAYERS)}
        nx, ny, nz = self.maps[f"normal_{f:02d}"][:, inner, inner]
        z, known, has_normal = self.maps["center"][f][2], layer["is_valid"] > 0.5, nz > 0
        slope = np.where(has_normal, nz, 1.0)
        values = dict(
            elevation=layer["elevation"] + z, variance=layer["variance"], validity=known, support=layer["is_valid"],
            time=layer["time"], upper_bound=layer["upper_bound"] + z, bounded=(layer["is_upper_bound"] > 0.5) & ~known,
            gradient_x=-nx / slope, gradient_y=-ny / slope, has_normal=has_normal,
            traversability=layer["traversability"], rated=known,
        )  # fmt: skip
        tensors: Any = {name: torch.from_numpy(np.asarray(value)[None]) for name, value in values.items()}
        corner = torch.from_numpy(self.corner_of(f)[None])
        blank: MapState = ElevationMap(self.emap.cfg).state
        self.emap.load_state(blank._replace(corner=corner, **tensors))

    def corner_of(self, f: int) -> Array:
        """Return the corner of the recorded window [cells]."""
        grid = self.emap.cfg.grid
        center = np.round(self.maps["center"][f][:2] / grid.resolution).astype(np.int64)
        corner: Array = center - np.array([grid.height, grid.width]) // 2
        return corner

    def compare(self, f: int, kind: str) -> dict[str, float]:
        """Return the share of cells that lie between the recorded values of frame f, where both windows have them."""
        low, high = (self.maps[f"map_{f:02d}"].copy() for _ in range(2))
        index = self.maps[f"{kind}_{f:02d}_idx"]
        low.ravel()[index], high.ravel()[index] = (self.maps[f"{kind}_{f:02d}_{end}"] for end in ("lo", "hi"))
        shift = self.emap.state.corner[0].numpy() - self.corner_of(f)  # 0, or 1 where the robot is half-way
        ours = tuple(slice(max(0, -s), low.shape[1] - 2 - max(0, s)) for s in shift)
        theirs = tuple(slice(part.start + s + 1, part.stop + s + 1) for part, s in zip(ours, shift, strict=True))
        low, high = low[(slice(None), *theirs)], high[(slice(None), *theirs)]  # they have a border of one cell
        state = {name: getattr(self.emap.state, name)[0].numpy()[ours] for name in ("validity", "bounded", *TOLERANCES)}
        return _shares(state, dict(zip(LAYERS, low, strict=True)), dict(zip(LAYERS, high, strict=True)),
                       self.maps["center"][f][2])  # fmt: skip


def _shares(ours: dict[str, Array], low: dict[str, Array], high: dict[str, Array], z: float) -> dict[str, float]:
    may, must = high["is_valid"] > 0.5, low["is_valid"] > 0.5
    known = ours["validity"] & must
    bound = ~ours["validity"] & ~may & ours["bounded"] & (low["is_upper_bound"] > 0.5)
    shares = {"validity": float(((ours["validity"] >= must) & (ours["validity"] <= may)).mean())}
    for name, tolerance in TOLERANCES.items():
        value = ours[name] - (z if name in ("elevation", "upper_bound") else 0)
        agrees = (value >= low[name] - tolerance) & (value <= high[name] + tolerance)
        chosen = bound if name == "upper_bound" else known
        shares[name] = float(agrees[chosen].mean()) if chosen.any() else 1.0
    return shares


def evaluate(folder: Path, name: str, weights: Path | None) -> dict[str, Any]:
    """Return the lowest shares of a scene's single steps, and of its whole run."""
    steps = []
    for f in Scene(folder, name, weights).maps["step_frames"]:
        scene = Scene(folder, name, weights)
        if f > 0:
            scene.load(int(f) - 1)
        scene.update(int(f))
        steps.append(scene.compare(int(f), "step"))
    scene, runs = Scene(folder, name, weights), []
    for f in range(scene.frames):
        scene.update(f)
        if f"run_{f:02d}_idx" in scene.maps and f in scene.maps["keep"]:
            runs.append(scene.compare(f, "run"))
    lowest = ({key: min(shares[key] for shares in found) for key in COLUMNS} for found in (steps, runs))
    return dict(zip(("step", "run"), lowest, strict=True)) | {"steps": len(steps), "runs": len(runs)}


def time_updates() -> dict[str, float]:
    """Return the median time [ms] of an update of one robot by the default config and by the mode, in turns."""
    modes = {
        "default": full_config(),
        "like_em_cupy": ElevationMapConfig.like_em_cupy(resolution=0.04, map_length=10.0),
    }
    drives = {name: Drive(cfg, BPEARL) for name, cfg in modes.items()}
    times: dict[str, list[float]] = {name: [] for name in drives}
    for k in range(4 + 20):
        for name, drive in drives.items() if k % 2 else reversed(drives.items()):
            start = time.perf_counter()
            drive()
            times[name] += [time.perf_counter() - start] if k >= 4 else []
    return {name: 1e3 * statistics.median(values) for name, values in times.items()}


def table(result: dict[str, Any]) -> str:
    """Tabulate the shares [%]: after one step / in the run."""
    rows = [
        [scene, *(" / ".join(f"{100 * found[kind][key]:.1f}" for kind in ("step", "run")) for key in COLUMNS)]
        for scene, found in result["scenes"].items()
    ]
    head = [key.replace("_", " ") for key in COLUMNS]
    own, usual = (f"{result['milliseconds'][name]:.1f}" for name in ("like_em_cupy", "default"))
    note = f"An update with {BPEARL:,} points: {own} ms, {usual} by default; one robot, {result['threads']} threads."
    return f"{markdown_table(['scene', *head], rows)}\n\n{channels_table(result['channels'])}\n\n{note}"


def main() -> None:
    """Compare all scenes of a folder."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])  # type: ignore[union-attr]
    parser.add_argument("folder", type=Path, help="with <scene>.inputs.npz and <scene>.f32.npz")
    parser.add_argument("--weights", type=Path, help=".npz of the traversability filter")
    arguments = parser.parse_args()
    names = sorted(path.name.removesuffix(".inputs.npz") for path in arguments.folder.glob("*.inputs.npz"))
    if not names:
        parser.error(f"{arguments.folder}: must hold <scene>.inputs.npz, got none; give the folder of the recordings")
    result: dict[str, Any] = {"scenes": {name: evaluate(arguments.folder, name, arguments.weights) for name in names}}
    result["channels"] = evaluate_channels(arguments.folder)
    result |= {"milliseconds": time_updates(), "threads": torch.get_num_threads()}
    write_json(RESULTS / "em_cupy.json", result)
    print(table(result))


if __name__ == "__main__":
    main()
