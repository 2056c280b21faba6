"""What each feature of the map is worth: one simulated recording each, the feature on, off, and the plain baseline.

    python -m benchmarks.quality.features

on         the default configuration
off        the default with this one feature set to None (`drift`, `raycast`, `overlap`, `fusion.edges`,
           `sensor.exclusion`)
baseline   transform, noise, height update only: everything that can be None is None

All three fuse the same recording: the scene's exact returns with range noise (3 mm + 1.5 mm/m^2 * d^2 for the camera,
1 cm for the lidar) and 2 % lost, at 5 Hz, on a robot that walks with bob, roll and pitch. Cells are 4 cm. The truth of
a cell is the height of the ground at its centre. Every metric is defined in the docstring of its function in
`feature_metrics.py`; a `bar` is what must hold with the feature on. Prints a markdown table, writes
`results/features.json` and `results/features.png` (the last maps, as elevation).
"""

from __future__ import annotations

import dataclasses
import textwrap
import time
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import click
import torch

from benchmarks.quality import feature_metrics as metrics
from benchmarks.quality import feature_recordings as rec
from benchmarks.quality.feature_metrics import GRID, Figures
from benchmarks.quality.feature_recordings import SimulatedRun
from torchelev.app.results import machine, markdown_table, write_json
from torchelev.config import ElevationMapConfig
from torchelev.elevation_map import ElevationMap

RESULTS = Path(__file__).parents[1] / "results"


@dataclasses.dataclass(frozen=True)
class Feature:
    """A recording, how it is measured, what switches the feature off, and what must hold with it on."""

    name: str
    record: Callable[[], SimulatedRun]
    measure: Callable[[SimulatedRun, ElevationMapConfig], tuple[Figures, ElevationMap]]
    off: str  # dotted name of the setting that is set to None
    bars: dict[str, tuple[str, float]]  # metric -> ("<=" or ">=", limit)
    shown: tuple[str, ...] = ()  # metrics in the picture besides the first of the bars


LEFT = {"left [%]": ("<=", 1.0)}
REMOVED = {"removed [%]": ("<=", 0.5)}
OVERHANG = {"overhang [%]": ("<=", 0.2), "obstacle mapped [%]": (">=", 90.0)}
SEAM = {"seam [cm]": ("<=", 1.0), "seam mean [cm]": ("<=", 1.0)}
WALLS = {name: ("<=", 2.0) for name in ("top cells [cm]", "wall top [cm]", "tall wall top [cm]")}
FLOOR = {"other floor [%]": ("<=", 1.0)}
BOUNDS = {"bounded [%]": (">=", 60.0), "below truth [%]": ("<=", 1.0)}
WRONG = 0.01  # share of returns that are too long

FEATURES = (
    Feature("drift compensation", rec.record_drift, metrics.seam_step, "drift", SEAM),
    Feature("cleanup: person", rec.record_person, metrics.cells_left, "raycast", LEFT),
    Feature("cleanup: person, 1 % too long", partial(rec.record_person, WRONG), metrics.cells_left, "raycast", LEFT),
    Feature("cleanup: static", rec.record_static, metrics.wrongly_removed, "raycast", REMOVED),
    Feature(
        "cleanup: static, 1 % too long", partial(rec.record_static, WRONG), metrics.wrongly_removed, "raycast", REMOVED
    ),
    Feature(
        "exclusion area",
        rec.record_overhang,
        metrics.overhang_cells,
        "sensor.exclusion",
        OVERHANG,
        shown=("bar at the end [%]", "ceiling at the end [%]"),
    ),  # fmt: skip
    Feature("edges", rec.record_walls, metrics.wall_tops, "fusion.edges", WALLS),
    Feature("overlap clearance: up", partial(rec.record_floors, True), metrics.other_floor, "overlap", FLOOR),
    Feature("overlap clearance: down", partial(rec.record_floors, False), metrics.other_floor, "overlap", FLOOR),
    Feature("upper bound", rec.record_hidden, metrics.bounds, "raycast", BOUNDS),
    Feature("upper bound, 1 % too long", partial(rec.record_hidden, WRONG), metrics.bounds, "raycast", BOUNDS),
)
PICTURED = (
    "drift compensation", "cleanup: person", "exclusion area", "edges", "overlap clearance: up", "upper bound",
)  # fmt: skip


def configurations(off: str) -> dict[str, ElevationMapConfig]:
    """Return the three configurations of a feature."""
    on = ElevationMapConfig(grid=GRID)
    group, _, field = off.partition(".")
    part: Any = dataclasses.replace(getattr(on, group), **{field: None}) if field else None
    change: dict[str, Any] = {group: part}
    baseline = dataclasses.replace(
        on, drift=None, raycast=None, overlap=None, traversability=None,
        fusion=dataclasses.replace(on.fusion, edges=None),
        sensor=dataclasses.replace(on.sensor, exclusion=None, body=None),
    )  # fmt: skip
    return {"on": on, "off": dataclasses.replace(on, **change), "baseline": baseline}


def holds(value: float, bar: tuple[str, float]) -> bool:
    """Tell whether a figure meets its bar; NaN does not. Signed figures are judged by their size."""
    return abs(value) <= bar[1] if bar[0] == "<=" else value >= bar[1]


class Outcome(NamedTuple):
    """What one feature measured: figures by configuration, and the last maps for the picture."""

    feature: Feature
    figures: dict[str, Figures]
    maps: dict[str, ElevationMap]
    recording: SimulatedRun


def examine(feature: Feature) -> Outcome:
    """Record once, fuse three times."""
    start = time.perf_counter()
    recording = feature.record()
    figures, maps = {}, {}
    for name, cfg in configurations(feature.off).items():
        figures[name], maps[name] = feature.measure(recording, cfg)
    click.echo(f"{feature.name}: {time.perf_counter() - start:.0f} s", err=True)
    return Outcome(feature, figures, maps, recording)


HEAD = ["feature", "figure", "on", "off", "baseline", "bar", ""]


def table_rows(outcomes: list[Outcome]) -> list[list[str]]:
    """Return one row per figure: the three configurations, the bar and whether it holds."""
    rows = []
    for outcome in outcomes:
        for metric in outcome.figures["on"]:
            bar = outcome.feature.bars.get(metric)
            values = [f"{figures[metric]:.2f}" for figures in outcome.figures.values()]
            verdict = ("pass" if holds(outcome.figures["on"][metric], bar) else "FAIL") if bar else ""
            rows.append([outcome.feature.name, metric, *values, f"{bar[0]} {bar[1]:g}" if bar else "", verdict])
    return rows


def draw(outcomes: list[Outcome], path: Path) -> None:
    """Draw the last maps of every pictured feature beside the truth, on one colour scale per row."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    outcomes = [outcome for outcome in outcomes if outcome.feature.name in PICTURED]
    figure = Figure(figsize=(12.5, 2.15 * len(outcomes)), layout="compressed")
    FigureCanvasAgg(figure)
    axes = figure.subplots(len(outcomes), 4, squeeze=False)
    for row, outcome in zip(axes, outcomes, strict=True):
        draw_row(figure, row, outcome)
    for ax in axes[-1]:
        ax.set_xlabel("x [m]")
    figure.savefig(path, dpi=80)


def limits(*layers: torch.Tensor) -> tuple[float, float]:
    """Return heights [m] that leave 1 in 1000 cells of any layer off the colour scale at either end."""
    known = [layer[layer.isfinite()] for layer in layers]
    return min(float(z.quantile(0.001)) for z in known) - 0.02, max(float(z.quantile(0.999)) for z in known) + 0.02


def titled(figures: Figures, shown: tuple[str, ...]) -> str:
    """Write some figures in short."""
    parts = [(figures[metric], *metric.rstrip("]").partition(" [")) for metric in shown]
    return ", ".join(f"{what.removesuffix(' at the end')} {value:.1f} {unit}" for value, what, _, unit in parts)


def draw_row(figure, row, outcome: Outcome) -> None:
    """Draw truth, on, off and baseline of one feature."""
    xy = outcome.maps["on"].cell_centers()[0]
    truth = outcome.recording.truth(xy)
    layer = "upper_bound" if outcome.feature.measure is metrics.bounds else "elevation"
    low, high = limits(truth, outcome.maps["on"].layer("elevation")[0].double())
    layers = {"truth": truth, **{name: emap.layer(layer)[0] for name, emap in outcome.maps.items()}}
    corner, end = xy[0, 0] - GRID.resolution / 2, xy[-1, -1] + GRID.resolution / 2
    extent = (float(corner[0]), float(end[0]), float(corner[1]), float(end[1]))
    path = torch.stack([frame.T_map_base[0, :2, 3] for frame in outcome.recording.frames])
    shown = (next(iter(outcome.feature.bars)), *outcome.feature.shown)
    for ax, (name, values) in zip(row, layers.items(), strict=True):
        image = ax.imshow(values.T, origin="lower", extent=extent, vmin=low, vmax=high, interpolation="nearest")
        ax.set_facecolor("#d9d9d9")
        ax.plot(path[:, 0], path[:, 1], color="crimson", linewidth=0.8)
        ax.set(xlim=(-4, 4.5), ylim=(-3.2, 3.2))
        figures = outcome.figures.get(name)
        title = f"{name}: {titled(figures, shown)}" if figures else name
        ax.set_title(textwrap.fill(title, 32), fontsize=9)
    row[0].set_ylabel(f"{outcome.feature.name}\ny [m]", fontsize=9)
    figure.colorbar(image, ax=list(row), pad=0.01).set_label(f"{layer.replace('_', ' ')} [m]", fontsize=8)


@click.command()
@click.option("--out", type=click.Path(path_type=Path, file_okay=False), default=RESULTS, help="Where to write.")
@click.option("--only", default="", help="Measure the features whose name contains this, and write nothing.")
def main(out: Path, only: str) -> None:
    """Measure every feature on, off, and against the plain baseline."""
    measured_on = machine()  # read now: the checkout may move on while this runs
    outcomes = [examine(feature) for feature in FEATURES if only in feature.name]
    rows = table_rows(outcomes)
    click.echo(markdown_table(HEAD, rows))
    failed = [f"{row[0]}: {row[1]}" for row in rows if row[-1] == "FAIL"]
    click.echo(f"\n{len(failed)} bars fail" + "".join(f"\n  {line}" for line in failed))
    if not only:
        settings = {name: cfg.to_dict() for name, cfg in configurations("raycast").items()}
        named = [dict(zip(HEAD, row, strict=True)) for row in rows]
        write_json(out / "features.json", {"machine": measured_on, "rows": named, "configs": settings})
        draw(outcomes, out / "features.png")


if __name__ == "__main__":
    main()
