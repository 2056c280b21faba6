"""How far the map is from the truth, beside the plain per-cell mean and maximum of the same points.

    python -m benchmarks.quality.accuracy            # benchmarks/results/accuracy.json, accuracy.png and a table

Closed-form scenes; a 160 x 120 depth camera (86 x 58 degrees, pitched 35 degrees down) at 0.8 m turning on the spot,
the same camera on a walk with roll, pitch and bob, and a 32-ring lidar; each without and with noise, and with 8 % of
the points at wrong ranges along their ray. Scored are the cells within 2.5 m of the robot's last place, against the
true height at the cell's centre.
"""

from __future__ import annotations

import argparse
import functools
from collections.abc import Callable, Iterable
from dataclasses import asdict, dataclass
from typing import NamedTuple

import torch
from torch import Tensor
from tqdm import tqdm

from torchelev import ElevationMap, ElevationMapConfig, GridConfig
from torchelev.app.results import markdown_table, write_json
from torchelev.sim.exact import noise, scenes, sensors, trajectories
from torchelev.sim.exact.scenes import Scene

RADIUS = 2.5  # [m]
GRID = GridConfig(resolution=0.04, length_x=8.0, length_y=8.0)
SCENES: dict[str, Callable[[], Scene]] = {
    "flat": scenes.flat,
    "slope 15°": scenes.slope,
    "rough": scenes.rough,
    "stairs": scenes.stairs,
    "boxes": scenes.boxes,
    "mixed": scenes.mixed,
}
NOISES = {
    "none": lambda points, generator: points,
    "noisy": noise.noisy,
    "outliers": lambda points, generator: noise.outliers(
        noise.noisy(points, generator), generator, dust=0.03, flying=0.03, too_long=0.02
    ),
}


class SimulatedRun(NamedTuple):
    """One simulated run."""

    scene: Scene
    clean: list[Tensor]  # (M, 3) sensor frame
    T_map_sensor: Tensor  # (T, 4, 4)
    T_map_base: Tensor


def record(scene: Scene, motion: str) -> SimulatedRun:
    """Simulate a scene's scans."""
    sensor: sensors.DepthCamera | sensors.Lidar = sensors.DepthCamera()
    if motion == "turn":
        path = trajectories.turn_on_the_spot(0.8, 36, scene=scene)
    elif motion == "walk":
        path = trajectories.walk(scene, [(-1.5, 0.0), (0.5, 0.0), (0.5, 0.6)])
    else:
        sensor = sensors.Lidar()
        level = trajectories.mount(pitch_deg=0.0)
        path = trajectories.walk(scene, [(-1.0, 0.0), (0.2, 0.0)], speed=0.6, T_base_sensor=level)
    clean = [sensor.cast(scene, T, float(t)) for T, t in zip(path.T_map_sensor, path.times, strict=True)]
    return SimulatedRun(scene, clean, path.T_map_sensor, path.T_map_base)


@functools.cache
def recorded(name: str, motion: str) -> SimulatedRun:
    """Return a recording, simulated once."""
    return record(SCENES[name](), motion)


def corrupt(recording: SimulatedRun, kind: str) -> list[Tensor]:
    """Add noise to a recording's scans, the same in every run."""
    generator = torch.Generator().manual_seed(1)
    return [NOISES[kind](points, generator) for points in recording.clean]


class Cells(NamedTuple):
    """Plain statistics of the points in each cell of the window, (H, W)."""

    mean: Tensor
    maximum: Tensor
    number: Tensor
    mostly_right: Tensor  # more right points than wrong ones


def plain_cells(emap: ElevationMap, recording: SimulatedRun, scans: list[Tensor]) -> Cells:
    """Bin every point of the recording into the map's window: the plain baseline."""
    in_map = torch.cat(
        [p.double() @ T[:3, :3].T + T[:3, 3] for p, T in zip(scans, recording.T_map_sensor, strict=True)]
    )
    wrong = torch.cat([(p - q).norm(dim=-1) > 0.1 for p, q in zip(scans, recording.clean, strict=True)])
    index, inside = cell_of(emap, in_map)
    index, z, wrong = index[inside], in_map[inside, 2], wrong[inside]
    cells = GRID.num_cells
    number = torch.zeros(cells, dtype=torch.float64).index_add(0, index, torch.ones_like(z))
    bad = torch.zeros(cells, dtype=torch.float64).index_add(0, index, wrong.double())
    mean = torch.zeros(cells, dtype=torch.float64).index_add(0, index, z) / number
    top = torch.full((cells,), -torch.inf, dtype=torch.float64).scatter_reduce(0, index, z, "amax")
    shape = (GRID.height, GRID.width)
    return Cells(*(t.view(shape) for t in (mean, top, number, number > 2 * bad)))


def cell_of(emap: ElevationMap, points: Tensor) -> tuple[Tensor, Tensor]:
    """Return the flat cell index of map-frame points (M, 3), and which lie inside the window."""
    k = torch.floor(points[:, :2] / GRID.resolution) - emap.corner[0]
    inside = torch.isfinite(points).all(-1) & (k >= 0).all(-1) & (k < torch.tensor([GRID.height, GRID.width])).all(-1)
    k = torch.where(inside[:, None], k, 0).long()
    return k[:, 0] * GRID.width + k[:, 1], inside


def build_map(recording: SimulatedRun, scans: list[Tensor], cfg: ElevationMapConfig | None = None) -> ElevationMap:
    """Map a recording with default settings."""
    emap = ElevationMap(cfg or ElevationMapConfig(grid=GRID))
    for points, T_map_sensor, T_map_base in zip(scans, recording.T_map_sensor, recording.T_map_base, strict=True):
        emap.update(points[None], T_map_sensor[None], T_map_base[None], 0.1)
    return emap


@dataclass(frozen=True)
class Score:
    """One row of the table; heights in mm."""

    scene: str
    motion: str
    noise: str
    rmse: float
    rmse_mean: float
    rmse_max: float
    ratio: float  # rmse over the mean's, both at least 1 mm
    bias: float
    coverage: float  # share of the cells that points touched
    wrong_5cm: float  # share of cells outside the true heights of their 3 x 3 cells by more than 5 cm
    wrong_5cm_mean: float


def score(name: str, motion: str, kind: str, cfg: ElevationMapConfig | None = None) -> Score:
    """Map one recording and compare with the truth, the mean and the maximum."""
    recording = recorded(name, motion)
    scans = corrupt(recording, kind)
    emap = build_map(recording, scans, cfg)
    plain = plain_cells(emap, recording, scans)
    xy = emap.cell_centers()[0]
    truth = recording.scene.truth(xy)
    near = (xy - recording.T_map_base[-1, :2, 3]).norm(dim=-1) <= RADIUS
    touched = near & (plain.number > 0)
    if kind == "outliers":
        touched &= plain.mostly_right
    elevation = emap.layer("elevation")[0].double()
    both = touched & elevation.isfinite()
    error, mean, top = ((h - truth)[both] * 1e3 for h in (elevation, plain.mean, plain.maximum))
    low, high = true_range(recording.scene, xy)
    wrong, wrong_mean = (
        ((h - high).clamp(min=0) + (low - h).clamp(min=0))[both] > 0.05 for h in (elevation, plain.mean)
    )
    rmse, rmse_mean, rmse_max = (e.square().mean().sqrt().item() for e in (error, mean, top))
    return Score(
        name,
        motion,
        kind,
        rmse,
        rmse_mean,
        rmse_max,
        max(rmse, 1.0) / max(rmse_mean, 1.0),
        error.mean().item(),
        (both.sum() / touched.sum()).item(),
        wrong.double().mean().item(),
        wrong_mean.double().mean().item(),
    )


def true_range(scene: Scene, xy: Tensor) -> tuple[Tensor, Tensor]:
    """Return the lowest and highest true height of each cell and its neighbours: noise may take a point that far."""
    offsets = torch.linspace(-1.5, 1.5, 7, dtype=torch.float64) * GRID.resolution
    heights = torch.stack([scene.truth(xy + torch.stack([dx, dy])) for dx in offsets for dy in offsets])
    return heights.amin(0), heights.amax(0)


def all_rows() -> list[tuple[str, str, str]]:
    """List the combinations that are scored."""
    return [(s, m, n) for m in ("turn", "walk", "lidar") for s in SCENES for n in NOISES]


def meets(row: Score) -> bool:
    """Tell whether a row holds its bar."""
    good = row.coverage >= 0.995 and (row.scene != "flat" or row.noise == "outliers" or abs(row.bias) <= 1.0)
    if row.noise == "outliers":
        return good and row.ratio <= 0.85 and row.wrong_5cm <= 0.004
    return good and row.ratio <= 1.05


def table(rows: Iterable[Score]) -> str:
    """Format the rows as markdown."""
    head = ["scene", "motion", "noise", "map", "mean", "max", "map / mean", "bias", "coverage", "> 5 cm", "holds"]
    body = [
        [
            r.scene,
            r.motion,
            r.noise,
            f"{r.rmse:.1f}",
            f"{r.rmse_mean:.1f}",
            f"{r.rmse_max:.1f}",
            f"{r.ratio:.2f}",
            f"{r.bias:+.1f}",
            f"{r.coverage:.1%}",
            f"{r.wrong_5cm:.2%}",
            "yes" if meets(r) else "no",
        ]
        for r in rows
    ]
    return markdown_table(head, body)


def plot(path: str, rows: list[Score]) -> None:
    """Draw the map's error beside the mean's, a panel for each motion."""
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    figure, panels = plt.subplots(1, 3, figsize=(11, 4.2), sharex=True, layout="constrained")
    for panel, motion in zip(panels, ("turn", "walk", "lidar"), strict=True):
        part = [r for r in rows if r.motion == motion][::-1]
        places = range(len(part))
        panel.barh([k + 0.2 for k in places], [max(r.rmse, 0.1) for r in part], 0.4, label="torchelev")
        panel.barh([k - 0.2 for k in places], [max(r.rmse_mean, 0.1) for r in part], 0.4, label="per-cell mean")
        panel.set(xscale="log", xlim=(0.1, 100), xlabel="RMSE [mm]", title=motion)
        panel.set_yticks(list(places), [f"{r.scene}, {r.noise}" for r in part], fontsize=7)
        panel.grid(alpha=0.3, axis="x")
    panels[0].legend(fontsize=7)
    figure.savefig(path, dpi=100)
    plt.close(figure)


def main() -> None:
    """Run every row, write JSON and plot, print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", default="benchmarks/results", help="folder for accuracy.json (default: %(default)s)")
    parser.add_argument("--only", default="", help="only rows whose name contains this, such as 'stairs turn'")
    args = parser.parse_args()
    wanted = [row for row in all_rows() if args.only in " ".join(row)]
    rows = [score(*row) for row in tqdm(wanted, desc="accuracy")]
    print(table(rows))
    if not args.only:
        values = [asdict(r) | {"holds": meets(r)} for r in rows]
        write_json(f"{args.out}/accuracy.json", {"config": ElevationMapConfig(grid=GRID).to_dict(), "rows": values})
        plot(f"{args.out}/accuracy.png", rows)


if __name__ == "__main__":
    main()
