"""The figure of a speed result: time against points, robots, stages, cells and ray length."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from benchmarks.speed.workload import SENSORS


def draw(result: dict[str, Any], path: str | Path) -> None:
    """Draw a panel for each section that was measured."""
    from matplotlib.figure import Figure

    panels = {
        "points": _draw_points,
        "robots": _draw_robots,
        "stages": _draw_stages,
        "cells": _draw_cells,
        "rays": _draw_rays,
    }
    shown = [name for name in panels if name in result]
    if not shown:
        return
    rows = (len(shown) + 1) // 2
    columns = min(2, len(shown))
    figure = Figure(figsize=(5 * columns, 3.6 * rows), layout="constrained")
    axes = figure.subplots(rows, columns, squeeze=False)
    for ax in axes.flat[len(shown) :]:
        ax.axis("off")
    for ax, name in zip(axes.flat, shown, strict=False):
        panels[name](ax, result)
    machine = result["machine"]
    figure.suptitle(f"{machine['processor']}, {machine['threads']} threads, torch {machine['torch']}", fontsize=9)
    figure.savefig(path, dpi=90)


def _draw_points(ax: Any, result: dict[str, Any]) -> None:
    """Draw time against points, as in the paper's figure."""
    lines = (("full", "all stages", "o-"), ("baseline", "plain baseline", "s--"), ("eager", "eager", "^:"))
    for kind, label, style in lines:
        rows = sorted(result["points"][kind], key=lambda row: row["points"])
        ax.plot([r["points"] for r in rows], [r["median"] for r in rows], style, label=label)
    ax.set(xscale="log", yscale="log", xlabel="points", ylabel="time per update [ms]")
    ax.set_title("one robot, 10 x 10 m at 4 cm")
    _plain_ticks(ax.yaxis)
    for name, n, _, _ in SENSORS:
        ax.axvline(n, color="0.8", zorder=0)
        ax.text(n, ax.get_ylim()[0], f" {name}", rotation=90, va="bottom", ha="left", fontsize=7, color="0.4")
    ax.legend(loc="upper left", fontsize=8)
    ax.grid(alpha=0.3)


def _plain_ticks(axis: Any) -> None:
    """Label a logarithmic axis with 1, 2, 5, 10, ... instead of powers."""
    from matplotlib.ticker import LogLocator, NullFormatter, ScalarFormatter

    axis.set_major_locator(LogLocator(subs=(1, 2, 5)))
    axis.set_major_formatter(ScalarFormatter())
    axis.set_minor_formatter(NullFormatter())


def _draw_robots(ax: Any, result: dict[str, Any]) -> None:
    """Draw time and memory per robot against robots."""
    rows = result["robots"]["rows"]
    count = [r["robots"] for r in rows]
    ax.plot(count, [1e3 * r["ms_per_robot"] for r in rows], "o-", label="time")
    title = f"{result['robots']['cells']} x {result['robots']['cells']} cells, {result['robots']['points']} points each"
    ax.set(xscale="log", xlabel="robots", ylabel="time per robot [µs]", title=title)
    ax.set_ylim(bottom=0)
    memory = ax.twinx()
    memory.plot(count, [r["bytes_per_robot"] / 1e3 for r in rows], "s--", color="C1", label="memory")
    memory.axhline(result["robots"]["needed_bytes_per_robot"] / 1e3, color="C1", alpha=0.4, linestyle=":")
    memory.set_ylabel("kB per robot; dotted: need on paper")
    memory.set_ylim(bottom=0)
    ax.legend(handles=[ax.lines[0], memory.lines[0]], fontsize=8)
    ax.grid(alpha=0.3)


def _draw_stages(ax: Any, result: dict[str, Any]) -> None:
    """Draw each stage's time."""
    times = result["stages"]["stages"]
    names = [name for name in times if name != "the whole update"][::-1]
    ax.barh(names, [times[name]["median"] for name in names])
    ax.set(xlabel="time [ms], each compiled alone", title=f"stages, {result['stages']['points']:,} points")
    ax.grid(alpha=0.3, axis="x")


def _draw_cells(ax: Any, result: dict[str, Any]) -> None:
    """Draw time against cells."""
    rows, exponent = result["cells"]["rows"], result["cells"]["exponent"]
    ax.plot([r["cells"] for r in rows], [r["median"] for r in rows], "o-")
    ax.set(xscale="log", yscale="log", xlabel="cells", ylabel="time per update [ms]")
    ax.set_title(f"{result['cells']['points']:,} points, exponent {exponent:.2f}")
    _plain_ticks(ax.yaxis)
    ax.grid(alpha=0.3, which="both")


def _draw_rays(ax: Any, result: dict[str, Any]) -> None:
    """Draw time against ray length."""
    rows, exponent = result["rays"]["rows"], result["rays"]["exponent"]
    ax.plot([r["metres"] for r in rows], [r["median"] for r in rows], "o-")
    ax.set(xlabel="length of half of the rays [m]; the window ends at 5 m", ylabel="time per update [ms]")
    ax.set_title(f"{result['rays']['points']:,} points, exponent {exponent:.2f}")
    ax.set_ylim(0, 1.2 * max(r["median"] for r in rows))
    ax.grid(alpha=0.3)
