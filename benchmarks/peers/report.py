"""The tables and the picture of the peers, from their scores."""

from __future__ import annotations

import statistics
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any, NamedTuple

from torchelev.app.results import markdown_table
from torchelev.viz.style import make_figure, styled, write

Scores = dict[str, dict[str, dict[str, Any]]]  # by recording and peer
CAMERA, LIDAR = "depth camera", "lidar"
GROUPS = {CAMERA: ("stairs", "mixed", "rough, odometry drifts", "a person leaves", "a crate comes and goes"),
          LIDAR: ("mixed, lidar", "a person leaves, lidar")}  # fmt: skip
NEVER = 10**6  # scans


class Column(NamedTuple):
    """A column of the table."""

    title: str
    key: str
    scale: float
    digits: int
    better: Callable[[float], float]  #: of two values, the better one has the lower one of this


COLUMNS = (
    Column("RMSE [cm]", "rmse", 100, 1, abs),
    Column("at steps [cm]", "rmse_at_steps", 100, 1, abs),
    Column("bias [mm]", "bias", 1000, 1, abs),
    Column("coverage [%]", "coverage", 100, 0, lambda value: -value),
    Column("within 2 σ [%]", "within_2_std", 100, 0, lambda value: abs(value - 95.4)),
    Column("steep rated safe [%]", "steep_rated_safe", 100, 0, abs),
    Column("ghosts [%]", "ghosts", 100, 0, abs),
    Column("reaction [scans]", "reaction_scans", 1, 0, abs),
    Column("p50 [ms]", "p50_ms", 1, 1, abs),
    Column("p99 [ms]", "p99_ms", 1, 1, abs),
    Column("CPU [ms]", "cpu_ms", 1, 1, abs),
    Column("memory [MB]", "memory_mb", 1, 0, abs),
)


def tables(result: dict[str, Any]) -> str:
    """Return all tables, one below the other."""
    parts = [f"{group}:\n\n{table(result, group)}" for group in GROUPS if average(result, group)]
    return "\n\n".join([*parts, by_recording(result), settings(result)])


def table(result: dict[str, Any], group: str) -> str:
    """Tabulate a group of recordings; the best values of a column are bold."""
    found, peers = average(result, group), result["peers"]
    columns = [column for column in COLUMNS if any(column.key in values for values in found.values())]
    best = {c.key: min(_rank(c, v[c.key]) for v in found.values() if c.key in v) for c in columns}
    lines = [
        [f"{peers[peer]['title']} {peers[peer]['version']}".strip(), *(_cell(c, values, best[c.key]) for c in columns)]
        for peer, values in found.items()
    ]
    return markdown_table(["map", *(column.title for column in columns)], lines)


def by_recording(result: dict[str, Any]) -> str:
    """Tabulate the RMSE [cm] of each recording and, in brackets, the coverage [%]; the lowest error is bold."""
    scores, column = result["recordings"], COLUMNS[0]
    best = {name: min(_rank(column, row["rmse"]) for row in rows.values()) for name, rows in scores.items()}
    lines = []
    for peer, about in result["peers"].items():
        cells = []
        for name, rows in scores.items():
            row = rows.get(peer)
            cells.append(f"{_cell(column, row, best[name])} ({100 * row['coverage']:.0f})" if row else "")
        lines.append([about["title"], *cells])
    return markdown_table(["map", *scores], lines)


def average(result: dict[str, Any], group: str) -> dict[str, dict[str, float]]:
    """Return the mean of each score over a group of recordings, by peer; of reactions the slowest."""
    scores = result["recordings"]
    return {peer: values for peer in result["peers"] if (values := _average(_rows(scores, GROUPS[group], peer)))}


def _rows(scores: Scores, names: Iterable[str], peer: str) -> list[dict[str, Any]]:
    """Return the scores of a peer on those of the recordings that it ran."""
    return [scores[name][peer] for name in names if peer in scores.get(name, {})]


def _average(rows: list[dict[str, Any]]) -> dict[str, float]:
    result: dict[str, float] = {}
    for key in (column.key for column in COLUMNS):
        values = [row[key] for row in rows if key in row]
        if key == "reaction_scans":
            scans = [NEVER if scan is None else scan for row in values for scan in row]
            values = [max(scans)] if scans else []
        if values:
            result[key] = statistics.fmean(values)
    return result


def _rank(column: Column, value: float) -> float:
    """Return a number that is lower for better values, equal for those that read the same."""
    return round(column.better(column.scale * value), column.digits)


def cell_text(column: Column, value: float) -> str:
    """Return a value as the tables show it."""
    return "never" if value >= NEVER else f"{column.scale * value:.{column.digits}f}"


def _cell(column: Column, values: dict[str, float], best: float) -> str:
    value = values.get(column.key)
    if value is None:
        return ""
    text, is_best = cell_text(column, value), value < NEVER and _rank(column, value) == best
    return f"**{text}**" if is_best else text


def settings(result: dict[str, Any]) -> str:
    """Tabulate the settings of each peer."""
    rows: Iterable[list[str]] = (
        [about["title"], about["version"] or "–", about["settings"]] for about in result["peers"].values()
    )
    return markdown_table(["map", "version", "settings"], list(rows))


@styled()
def draw(path: Path, result: dict[str, Any]) -> None:
    """Draw error against latency, a point for each peer: recordings of a depth camera."""
    figure = make_figure(7.5, 3.8)
    ax = figure.subplots()
    for k, (peer, values) in enumerate(average(result, CAMERA).items()):
        label = f"{result['peers'][peer]['title']}: {100 * values['coverage']:.0f} % covered"
        shape = "*" if peer == "torchelev_map" else "osD^vPXhd<>"[(k - 1) % 11]
        ax.plot(
            values["p50_ms"], 100 * values["rmse"], shape, color=f"C{k}", markersize=16 if k == 0 else 9, label=label
        )
    ax.set(xscale="log", xlabel="median time of a scan [ms]", ylabel="RMSE of the ground [cm]")
    ticks = (1, 3, 10, 30, 100)
    ax.set_xticks(ticks, [str(tick) for tick in ticks])
    ax.set_xticks([], minor=True)
    ax.margins(y=0.15)
    ax.set_ylim(bottom=0)
    figure.legend(loc="outside right center")
    write(figure, path)
