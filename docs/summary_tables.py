"""The small tables of docs/benchmarks.md, each with a few numbers of the results that its detail pages hold."""

from __future__ import annotations

from collections.abc import Iterable
from statistics import mean
from typing import Any

import training
from benchmarks.peers import report
from benchmarks.speed.common.workload import BPEARL, SENSORS
from benchmarks.speed.update import tables
from docs.results import GPU, SPEED, load
from torchelev.app.results import markdown_table


def speed() -> str:
    """Tabulate the time of updates and height scans, those of a GPU first, and those of peers."""
    gpu, cpu, levels, filters = load(GPU), load(SPEED), load("levels"), load("postprocessing")
    size = gpu["many robots"]
    copied = 1e3 * gpu["many robots, expected bytes"] / gpu["copy, bytes per second"]
    captured = [
        ("one robot, captured", "1 robot, 43,074 points", ""),
        (
            "many robots, captured",
            f"{size['robots']:,} robots, {size['points']:,} points each",
            f"a copy of the bytes: {copied:.1f} ms",
        ),
        ("height scans, captured", f"{size['robots']:,} height scans of 187 points", ""),
    ]
    device = gpu["machine"]["device"].split(" 80GB")[0]
    rows = [[device, case, f"{gpu[name]['median']:.2g} ms", peer] for name, case, peer in captured]
    by_points = {row["points"]: row["median"] for row in cpu["points"]["full"]}
    hertz = next(rate for _, points, rate, _ in SENSORS if points == BPEARL)
    paper = f"the paper's, Xavier GPU: {1e3 / hertz:.0f} ms"
    rows.append([_processor(cpu), f"1 robot, {BPEARL:,} points", f"{by_points[BPEARL]:.1f} ms", paper])
    many = next(row for row in cpu["robots"]["rows"] if row["robots"] == 256)
    rows.append([_processor(cpu), "256 robots, 512 points each", f"{many['median']:.0f} ms", ""])
    times = {name: f"{row['milliseconds']:.3g} ms" for name, row in levels["beside"]["all"].items()}
    others = ", ".join(f"{name}: {times[name]}" for name in ("OctoMap", "VDBFusion"))
    rows.append([_processor(levels), "1 scan of a 64-ring lidar, with levels", times["levels"], others])
    ratios = [row["ratio"] for row in filters["rows"] if row.get("ratio")]
    span = f"{min(ratios):.1f} to {max(ratios):.1f} times theirs"
    rows.append([_processor(filters), "filters of 1 to 256 maps", span, "OpenCV, SciPy"])
    return markdown_table(["on", "task", "torchelev", "compared with"], rows)


PEER_SCORES = {  # the columns of the peers' table that are summed up
    "rmse": "error of the ground, RMSE [cm]",
    "rmse_at_steps": "error at steps, RMSE [cm]",
    "reaction_scans": "scans until a change shows in the map",
    "p50_ms": "median time of a depth image [ms]",
}


def peers() -> str:
    """Tabulate torchelev beside the best and the worst of the other maps, on recordings of a depth camera."""
    result = load("peers")
    (_, own), *others = report.average(result, report.CAMERA).items()
    columns, rows = {column.key: column for column in report.COLUMNS}, []
    for key, title in PEER_SCORES.items():
        order = sorted((values[key], name) for name, values in others if key in values)
        cells = [report.cell_text(columns[key], own[key])]
        for value, name in (order[0], order[-1]):
            cells.append(f"{report.cell_text(columns[key], value)}: {result['peers'][name]['title']}")
        rows.append([title, *cells])
    return markdown_table(["", "torchelev", "best other map", "worst other map"], rows)


def _processor(result: dict[str, Any]) -> str:
    return result["machine"]["processor"]


def accuracy() -> str:
    """Tabulate errors, and those of peers."""
    cases = {(row["scene"], row["motion"], row["noise"]): row for row in load("accuracy")["rows"]}
    real = {(row["recording"], row["resolution_m"], row["method"]): row for row in load("real")["rows"]}
    beside, poses = load("levels")["beside"]["all"], load("pose_covariance")["rows"]
    rows = []
    for scene, noise, what in (("flat", "outliers", "flat ground, 8 % outliers"), ("stairs", "noisy", "stairs, noise")):
        row = cases[scene, "walk", noise]
        rows.append([f"RMSE, {what}", f"{row['rmse']:.1f} mm", f"mean of the points: {row['rmse_mean']:.1f} mm"])
    own, plain = (real["offroad", 0.1, name]["flat_p90_m"] for name in ("torchelev", "mean of all points"))
    rows.append(["p90 on a real off-road scan", f"{100 * own:.1f} cm", f"mean of the points: {100 * plain:.1f} cm"])
    ground = {name: f"{100 * beside[name]['ground_rmse']:.1f} cm" for name in beside}
    peers = ", ".join(f"{name}: {ground[name]}" for name in ("OctoMap", "VDBFusion"))
    rows.append(["RMSE of the ground below tables, bridges and lintels, with levels", ground["levels"], peers])
    uncertain = [row for row in poses if row["preset"] != "perfect"]
    inside = [_span(100 * row[kind]["inside"] for row in uncertain) for kind in ("with", "without")]
    rows.append(["true heights within ± 2 σ, drifting poses", f"{inside[0]} %", f"without covariance: {inside[1]} %"])
    scenes = load("em_cupy")["scenes"].values()
    agree = 100 * min(share for scene in scenes for kind in ("step", "run") for share in scene[kind].values())
    rows.append(["cells that agree with elevation_mapping_cupy", f"{agree:.1f} % or more", ""])
    return markdown_table(["measure", "torchelev", "compared with"], rows)


def learning() -> str:
    """Tabulate the success of policies by what they were trained with [%]."""
    nav, legs = (load(name, training.RESULTS)["rows"] for name in ("nav", "quadruped"))
    kinds = {"map": "the map in the loop", "truth": "the true ground with noise", "blind": "nothing (blind)"}
    rows = []
    for perception, title in kinds.items():
        reached = [100 * row["deployed"]["success"] for row in nav if row["perception"] == perception]
        runs = [row["deployed"] for row in legs if row["perception"] == perception]
        crossed = [100 * run["all"]["crossed"] for run in runs]
        stairs = mean(100 * run["by_kind"]["stairs up"]["crossed"] for run in runs)
        rows.append([title, *(f"{mean(v):.0f} ({_span(v)})" for v in (reached, crossed)), f"{stairs:.0f}"])
    head = ["trained with", "navigation: goals reached %", "quadruped: tiles crossed %", "of these, stairs up"]
    return markdown_table(head, rows)


def limits() -> str:
    """Tabulate where torchelev is worse than its targets or than others."""
    verdicts = tables.verdicts(load(SPEED)).splitlines()[2:]
    missed = [row for row in verdicts if row.endswith("| missed |")]
    result = load("peers")
    beside = report.average(result, report.CAMERA)
    steps = {result["peers"][name]["title"]: 100 * row["rmse_at_steps"] for name, row in beside.items()}
    volume = min(steps, key=steps.__getitem__)
    updates, sight = load("levels_speed")["updates"], load("sight")["rows"]
    deepest = max(row["ratio"] for row in updates)
    em_cupy = load("em_cupy")["milliseconds"]
    left = load("changes")["ghosts"]["lidar 16 at 10 Hz"]
    ceilings = load("ceilings", training.RESULTS)["rows"]
    scan, none = (_success(ceilings, "sees", name) for name in ("scan", "none"))
    fills = load("fill", training.RESULTS)["rows"]
    base, inpaint = (_success(fills, "fill", name) for name in ("base", "inpaint"))
    heads = load("traversability", training.RESULTS)["held_out"]["4 cm"]
    unsafe = [100 * heads[name]["false_safe"] for name in heads if name.startswith("learned")]
    table = [
        ["speed targets missed", f"{len(missed)} of {len(verdicts)}"],
        [f"error at steps; {volume}'s error", f"{steps['torchelev']:.1f} cm; {steps[volume]:.1f} cm"],
        ["time of an update with three levels, relative to one level", f"up to {deepest:.1f} times"],
        [
            "time of an update like elevation_mapping_cupy's, relative to the default",
            f"{em_cupy['like_em_cupy'] / em_cupy['default']:.0f} times",
        ],
        [
            "time of an environment step with the map, relative to the true ground",
            f"{sight['step, map']['median'] / sight['step, truth']['median']:.1f} times",
        ],
        [
            "cells that remain after a person left, 16-ring lidar",
            f"{left['cells'] / left['of']:.0f} per robot, {left['environments']} of {left['of']} robots",
        ],
        ["goals reached with a ceiling scan; without", f"{scan:.0f} %; {none:.0f} %"],
        ["goals reached with in-painted unknown pixels; with nominal ground", f"{inpaint:.0f} %; {base:.0f} %"],
        ["learned head: unsafe cells rated safe when 95 % of the safe cells are", f"{mean(unsafe):.0f} %"],
    ]
    return markdown_table(["limit", "result"], table)


def _success(rows: list[dict[str, Any]], key: str, value: str) -> float:
    """Return the mean success [%] of the policies of a kind."""
    return mean(100 * row["deployed"]["success"] for row in rows if row[key] == value)


def _span(values: Iterable[float]) -> str:
    """Return the lowest and highest value."""
    values = list(values)
    return f"{min(values):.0f} to {max(values):.0f}"
