"""Every table of the pages, made from its result."""

from __future__ import annotations

import functools
from collections.abc import Callable
from pathlib import Path
from typing import Any

import benchmarks
import training
from benchmarks.gpu import report as gpu
from benchmarks.peers import report as peers
from benchmarks.quality import (
    classes,
    em_cupy,
    mjlab_task,
    mjlab_training,
    obstacles,
    pose_covariance,
)
from benchmarks.quality.changes import report as changes
from benchmarks.quality.isaac_lab import report as isaac_lab
from benchmarks.quality.levels import __main__ as levels
from benchmarks.quality.levels import one_height
from benchmarks.quality.occlusion import report as occlusion
from benchmarks.quality.odometry import report as odometry
from benchmarks.quality.real import merged
from benchmarks.runtime import report as runtime
from benchmarks.runtime import spacing
from benchmarks.self_filter import __main__ as self_filter
from benchmarks.self_filter import walking
from benchmarks.speed import (
    bags,
    channels,
    encoders,
    head,
    live_view,
    long_run,
    loop,
    sensors,
    sight,
    structures,
)
from benchmarks.speed import levels as levels_speed
from benchmarks.speed.common import growth
from benchmarks.speed.postprocessing import __main__ as postprocessing
from benchmarks.speed.site import site_area, site_engines, site_merge, site_ranks, site_service
from benchmarks.speed.update import tables
from docs import summary_tables as summary
from docs.results import GPU, SPEED, load
from docs.table_shapes import in_parts, rows_of, transposed, upright
from torchelev.app.results import markdown_table
from training.nav import ceiling_experiment, encoder_experiment, experiment, fill_experiment
from training.quadruped import experiment as legs
from training.quadruped import fills, step_time
from training.traversability import block, evaluate


def _accuracy() -> str:
    """Tabulate the RMSE of map / mean [mm] by scene, and count the cases that meet their targets."""
    rows = load("accuracy")["rows"]
    cells = {(f"{r['motion']}, {r['noise']}", r["scene"]): f"{r['rmse']:.1f} / {r['rmse_mean']:.1f}" for r in rows}
    cases, scenes = (list(dict.fromkeys(names)) for names in zip(*cells, strict=True))
    table = markdown_table(["motion, noise", *scenes], [[case, *(cells[case, s] for s in scenes)] for case in cases])
    failed = [f"*{r['scene']} {r['motion']} {r['noise']}*" for r in rows if not r["holds"]]
    missed = f"; missed: {', '.join(failed)}" if failed else ""
    return f"{table}\n\n{len(rows) - len(failed)} of {len(rows)} cases meet their targets{missed}."


def _features() -> str:
    """Tabulate the figures that have a target."""
    rows = [list(r.values()) for r in load("features")["rows"] if r["bar"]]
    return markdown_table(["feature", "figure", "on", "off", "baseline", "target", ""], rows)


def _real() -> str:
    """Tabulate the errors at held-out points on flat cells."""
    head = ["recording", "cell", "method", "median", "p90", "coverage", "ms / scan"]
    rows = []
    for r in load("real")["rows"]:
        errors = [f"{100 * r[name]:.1f} cm" for name in ("flat_median_m", "flat_p90_m")]
        time = f"{r['ms_per_scan']:.0f}" if r.get("ms_per_scan") else ""
        cell = f"{100 * r['resolution_m']:.0f} cm"
        rows.append([r["recording"], cell, r["method"], *errors, f"{100 * r['coverage']:.1f} %", time])
    return markdown_table(head, rows)


def _occlusion() -> str:
    """Tabulate how often each rule for unknown ground is right [%]."""
    found = load("occlusion")
    table = transposed(occlusion.table(found["right [%]"], found["footholds within 3 cm [%]"]))
    return table.replace("in-painted by ", "").replace("| rule |", "| ground |")


def _speed_robots() -> str:
    """Tabulate time and memory against the number of robots, and show the figure."""
    picture = f"![Time against points, robots, cells and ray length](benchmarks/results/{SPEED}.png)"
    return f"{tables.robots(load(SPEED))}\n\n{picture}"


def _ros2() -> str:
    """Tabulate how old maps are when they arrive, by load."""
    found = load("ros2")
    usual, overload = found["10 Hz"], found["overload"]
    rows = {
        "10 Hz": usual,
        f"{overload['rate [Hz]']:g} Hz, first 30 s": overload["first 30 s"],
        f"{overload['rate [Hz]']:g} Hz, last 30 s of {overload['minutes']:g} min": overload["last 30 s"],
    }
    lines = [[name, f"{row['p50 [ms]']:.1f}", f"{row['p99 [ms]']:.1f}", str(row["maps"])] for name, row in rows.items()]
    (before, after), end = usual["memory [MB]"], overload["memory [MB]"]
    text = (
        f"CPU: {found['idle cpu [%]']:.0f} % of a core without clouds, {usual['cpu at default rates [%]']:.0f} % at "
        f"10 Hz with ~/points at its default rate, {usual['cpu [%]']:.0f} % above, where it is published 200 times a "
        "second. "
        f"Memory: {before:.0f} MB, {after:.0f} MB after a minute, "
        f"{end:.0f} MB at the end. Of {overload['sent']:,} clouds sent in the overload {overload['fused']:,} "
        "were fused; newer ones took the place of the others, in the middleware or in the node."
    )
    return f"{markdown_table(['clouds', 'p50 [ms]', 'p99 [ms]', 'maps'], lines)}\n\n{text}"


def _long_run() -> str:
    """Tabulate growth over long runs."""
    return growth.table({name: values for name, values in load("long_run").items() if name in long_run.CASES})


def _self_filter() -> str:
    """Tabulate what the self-filter takes, leaves and costs."""
    return self_filter.tables({name: value for name, value in load("self_filter").items() if name != "walking"})


def _traversability(split: str) -> str:
    """Tabulate the quality of the traversability heads on a split, a table for each size of cells."""
    result = load("traversability", training.RESULTS)[split]
    return "\n\n".join(_traversability_at(cells, heads) for cells, heads in result.items())


def _traversability_at(cells: str, heads: dict[str, Any]) -> str:
    """Tabulate the quality of the heads at one size of cells, a column each."""
    rows = rows_of(evaluate.table({"": {cells: heads}}, ""))
    head, *rows = [list(row) for row in zip(*(row[1:] for row in rows), strict=True)]
    return markdown_table([f"cells of {cells}", *head[1:]], rows)


def _made_by(
    make: Callable[[Any], str], name: str, part: str | None = None, folder: Path = benchmarks.RESULTS
) -> Callable[[], str]:
    """Return what tabulates a result, or a part of it, by the function of its module."""
    return lambda: make(load(name, folder) if part is None else load(name, folder)[part])


TABLES: dict[str, Callable[[], str]] = {
    "summary_speed": summary.speed,
    "summary_accuracy": summary.accuracy,
    "summary_peers": summary.peers,
    "summary_learning": summary.learning,
    "summary_limits": summary.limits,
    "peers_camera": lambda: peers.table(load("peers"), peers.CAMERA),
    "peers_lidar": lambda: peers.table(load("peers"), peers.LIDAR),
    "peers_recordings": lambda: peers.by_recording(load("peers")),
    "peers_settings": lambda: peers.settings(load("peers")),
    "accuracy": _accuracy,
    "features": _features,
    **in_parts(_made_by(changes.tables, "changes"), "changes", "changes_aging", "changes_left"),
    "real": _real,
    "speed": upright(_made_by(tables.sensors, SPEED)),
    "speed_threads": _made_by(tables.threads, SPEED),
    "speed_stages": _made_by(tables.stages, SPEED),
    "speed_robots": _speed_robots,
    "speed_targets": _made_by(tables.verdicts, SPEED),
    "loop": _made_by(loop.table, "loop", "rows"),
    "runtime_speed": _made_by(runtime.speed_table, "runtime_speed"),
    "runtime_replay": _made_by(runtime.replay_table, "runtime_replay"),
    "runtime_spacing": _made_by(spacing.table, "runtime_spacing"),
    "runtime_processors": _made_by(runtime.processors_table, "runtime_processors"),
    "ros2": _ros2,
    "long_run": upright(_long_run),
    "odometry": _made_by(odometry.table, "odometry"),
    "bags": upright(_made_by(bags.table, "bags", "rows")),
    "live_view": _made_by(live_view.table, "live_view"),
    "site_engines": _made_by(site_engines.table, "site_engines", "rows"),
    "site_merge": upright(_made_by(site_merge.table, "site_merge", "rows")),
    "site_area": _made_by(site_area.table, "site_area", "rows"),
    "site_ranks": upright(_made_by(site_ranks.table, "site_ranks")),
    "site_service": upright(_made_by(site_service.table, "site_service")),
    "real_merged": _made_by(merged.table, "real_merged", "rows"),
    "nav": _made_by(experiment.table, "nav", folder=training.RESULTS),
    "pose_covariance": _made_by(pose_covariance.table, "pose_covariance"),
    "legs": upright(_made_by(legs.table, "quadruped", folder=training.RESULTS)),
    "legs_stairs": _made_by(legs.stairs_table, "quadruped", folder=training.RESULTS),
    "legs_walk": _made_by(legs.walk_table, "quadruped", folder=training.RESULTS),
    "legs_fills": upright(_made_by(fills.table, "quadruped_fills", folder=training.RESULTS)),
    "legs_step_time": _made_by(step_time.table, "quadruped-step-time", folder=training.RESULTS),
    "encoder_success": _made_by(encoder_experiment.table, "encoders", folder=training.RESULTS),
    "fill": upright(_made_by(fill_experiment.table, "fill", folder=training.RESULTS)),
    "ceilings": _made_by(ceiling_experiment.table, "ceilings", folder=training.RESULTS),
    "encoder_cost": _made_by(encoders.table, "encoders", "rows"),
    "sensors": _made_by(sensors.table, "sensors", "cases"),
    "structures": _made_by(structures.table, "structures"),
    "sight": _made_by(sight.table, "sight", "rows"),
    "mjlab": _made_by(mjlab_task.table, "mjlab"),
    **in_parts(_made_by(channels.table, "channels"), "channels", "channels_images"),
    "classes": _made_by(classes.table, "classes"),
    **in_parts(_made_by(levels.table, "levels"), "levels", "levels_peers", "levels_space"),
    "levels_accuracy": _made_by(one_height.table, "levels_accuracy", "rows"),
    **in_parts(_made_by(levels_speed.table, "levels_speed"), "levels_speed", "levels_voxels"),
    **in_parts(_made_by(em_cupy.table, "em_cupy"), "em_cupy", "em_cupy_channels"),
    "mjlab_training": _made_by(mjlab_training.table, "mjlab_training"),
    "isaac_lab": _made_by(isaac_lab.table, "isaac_lab"),
    "self_filter_walking": _made_by(walking.table, "self_filter", "walking"),
    "postprocessing": _made_by(postprocessing.table, "postprocessing", "rows"),
    "planes": _made_by(postprocessing.planes_table, "postprocessing", "planes"),
    "occlusion": _occlusion,
    "traversability": functools.partial(_traversability, "held_out"),
    "traversability_unseen": functools.partial(_traversability, "unseen"),
    "traversability_exact": functools.partial(_traversability, "held_out_exact"),
    "obstacles": _made_by(obstacles.table, "obstacles", "rows"),
    "head": _made_by(head.table, "head", "rows"),
    "block": _made_by(block.table, "block", "profiles", folder=training.RESULTS),
    **in_parts(_self_filter, "self_filter", "self_filter_padding"),
    "gpu": _made_by(gpu.table, GPU),
    "gpu_many": _made_by(gpu.costs, GPU),
}
