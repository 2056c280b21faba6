"""Each feature on, off and against the plain baseline, with the target that it must meet."""

from __future__ import annotations

import dataclasses
import time
from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple

import click

from benchmarks.quality.features import recordings as rec
from benchmarks.quality.features.floors import other_floor
from benchmarks.quality.features.overhang import overhang_cells
from benchmarks.quality.features.reading import GRID, Figures
from benchmarks.quality.features.recordings import SimulatedRun
from benchmarks.quality.features.seam import seam_step
from benchmarks.quality.features.visibility import bounds, cells_left, wrongly_removed
from benchmarks.quality.features.walls import wall_tops
from torchelev.config import ElevationMapConfig
from torchelev.elevation_map import ElevationMap


@dataclasses.dataclass(frozen=True)
class Feature:
    """A feature of the map and how it is measured."""

    name: str
    record: Callable[[], SimulatedRun]
    measure: Callable[[SimulatedRun, ElevationMapConfig], tuple[Figures, ElevationMap]]
    off: str  #: dotted name of the setting that is None when the feature is off
    bars: dict[str, tuple[str, float]]  #: targets with the feature on: metric -> ("<=" or ">=", limit)


_TOO_LONG = 0.01  # fraction of the returns

_LEFT = {"left [%]": ("<=", 1.0)}
_REMOVED = {"removed [%]": ("<=", 0.5)}
_OVERHANG = {"overhang [%]": ("<=", 0.2), "obstacle mapped [%]": (">=", 90.0)}
_SEAM = {"seam [cm]": ("<=", 1.0), "seam mean [cm]": ("<=", 1.0)}
_WALLS = {name: ("<=", 2.0) for name in ("top cells [cm]", "wall top [cm]", "tall wall top [cm]")}
_FLOOR = {"other floor [%]": ("<=", 1.0)}
_BOUNDS = {"bounded [%]": (">=", 60.0), "below truth [%]": ("<=", 1.0)}

FEATURES = (
    Feature("drift compensation", rec.record_drift, seam_step, "drift", _SEAM),
    Feature("cleanup: person", rec.record_person, cells_left, "raycast", _LEFT),
    Feature("cleanup: person, 1 % too long", partial(rec.record_person, _TOO_LONG), cells_left, "raycast", _LEFT),
    Feature("cleanup: static", rec.record_static, wrongly_removed, "raycast", _REMOVED),
    Feature(
        "cleanup: static, 1 % too long", partial(rec.record_static, _TOO_LONG), wrongly_removed, "raycast", _REMOVED
    ),
    Feature("exclusion area", rec.record_overhang, overhang_cells, "sensor.exclusion", _OVERHANG),
    Feature("edges", rec.record_walls, wall_tops, "fusion.edges", _WALLS),
    Feature("overlap clearance: up", partial(rec.record_floors, True), other_floor, "overlap", _FLOOR),
    Feature("overlap clearance: down", partial(rec.record_floors, False), other_floor, "overlap", _FLOOR),
    Feature("upper bound", rec.record_hidden, bounds, "raycast", _BOUNDS),
    Feature("upper bound, 1 % too long", partial(rec.record_hidden, _TOO_LONG), bounds, "raycast", _BOUNDS),
)


def configurations(off: str) -> dict[str, ElevationMapConfig]:
    """Return the configurations with a feature on, with it off, and of the plain baseline."""
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


def _meets(value: float, bar: tuple[str, float]) -> bool:
    """Return whether a figure meets its target, an upper limit by its absolute value; NaN does not."""
    return abs(value) <= bar[1] if bar[0] == "<=" else value >= bar[1]


class Outcome(NamedTuple):
    """The figures and the map to draw of each configuration."""

    feature: Feature
    figures: dict[str, Figures]
    maps: dict[str, ElevationMap]
    recording: SimulatedRun


def examine(feature: Feature) -> Outcome:
    """Record once and map with each configuration."""
    start = time.perf_counter()
    recording = feature.record()
    figures, maps = {}, {}
    for name, cfg in configurations(feature.off).items():
        figures[name], maps[name] = feature.measure(recording, cfg)
    click.echo(f"{feature.name}: {time.perf_counter() - start:.0f} s", err=True)
    return Outcome(feature, figures, maps, recording)


HEAD = ["feature", "figure", "on", "off", "baseline", "bar", ""]


def table_rows(outcomes: list[Outcome]) -> list[list[str]]:
    """Return a row per figure: its value by configuration, its target and the verdict."""
    rows = []
    for outcome in outcomes:
        for metric in outcome.figures["on"]:
            bar = outcome.feature.bars.get(metric)
            values = [f"{figures[metric]:.2f}" for figures in outcome.figures.values()]
            verdict = ("pass" if _meets(outcome.figures["on"][metric], bar) else "FAIL") if bar else ""
            rows.append([outcome.feature.name, metric, *values, f"{bar[0]} {bar[1]:g}" if bar else "", verdict])
    return rows
