"""Two figures of a speed result: one robot by points and stages, and scaling with robots, cells and ray length."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

from matplotlib.axes import Axes
from matplotlib.ticker import LogLocator, NullFormatter, NullLocator, ScalarFormatter

from benchmarks.speed.common.workload import SENSORS
from torchelev.viz.style import make_figure, styled, write

Panel = Callable[[Axes, dict[str, Any]], None]


def draw(result: dict[str, Any], path: str | Path) -> None:
    """Draw what was measured: time by points and stages to `path`, and scaling beside it, to `...-scaling.png`."""
    path = Path(path)
    _draw_figure(result, {"points": _draw_points, "stages": _draw_stages}, path)
    scaling: dict[str, Panel] = {"robots": _draw_robots, "cells": _draw_cells, "rays": _draw_rays}
    _draw_figure(result, scaling, path.with_stem(f"{path.stem}-scaling"))


@styled()
def _draw_figure(result: dict[str, Any], panels: dict[str, Panel], path: Path) -> None:
    """Draw a panel for each section that was measured, in one row."""
    shown = [name for name in panels if name in result]
    if not shown:
        return
    figure = make_figure(9 if len(shown) > 1 else 5, 4 if len(shown) < 3 else 3.4)
    for ax, name in zip(figure.subplots(1, len(shown), squeeze=False).flat, shown, strict=True):
        panels[name](ax, result)
        ax.grid()
    machine = result["machine"]
    figure.suptitle(f"{machine['processor']}, {machine['threads']} threads, torch {machine['torch']}", fontsize=10)
    write(figure, path)


def _draw_points(ax: Axes, result: dict[str, Any]) -> None:
    """Draw time against points, as in the paper's figure, with the sensors on the upper axis."""
    lines = (("full", "all stages", "o-"), ("baseline", "plain baseline", "s--"), ("eager", "by tensors", "^:"))
    for kind, label, style in lines:
        rows = sorted(result["points"][kind], key=lambda row: row["points"])
        ax.plot([r["points"] for r in rows], [r["median"] for r in rows], style, label=label)
    ax.set(xscale="log", yscale="log", xlabel="points; one robot, 10 x 10 m at 4 cm", ylabel="time per update [ms]")
    _plain_ticks(ax.yaxis)
    top = ax.secondary_xaxis("top")
    top.set_xticks([n for _, n, *_ in SENSORS], [name for name, *_ in SENSORS], rotation=30, ha="left", fontsize=9)
    top.xaxis.set_minor_locator(NullLocator())
    ax.legend(loc="center left", frameon=False)


def _plain_ticks(axis: Any) -> None:
    """Label a logarithmic axis with 1, 2, 5, 10, ... instead of powers."""
    axis.set_major_locator(LogLocator(subs=(1, 2, 5)))
    axis.set_major_formatter(ScalarFormatter())
    axis.set_minor_formatter(NullFormatter())


def _draw_stages(ax: Axes, result: dict[str, Any]) -> None:
    """Draw each stage's time."""
    times = result["stages"]["stages"]
    names = [name for name in times if name != "the whole update"][::-1]
    ax.barh(names, [times[name]["median"] for name in names])
    ax.set(xlabel=f"time [ms], each stage alone;\n{result['stages']['points']:,} points")
    ax.set_axisbelow(True)


def _draw_robots(ax: Axes, result: dict[str, Any]) -> None:
    """Draw time and memory per robot against robots."""
    robots = result["robots"]
    count = [r["robots"] for r in robots["rows"]]
    ax.plot(count, [1e3 * r["ms_per_robot"] for r in robots["rows"]], "o-", label="time")
    ax.set(xscale="log", xlabel="robots", ylabel="time per robot [µs]")
    ax.set_title(f"{robots['cells']} x {robots['cells']} cells, {robots['points']} points")
    ax.set_ylim(bottom=0)
    memory = ax.twinx()
    memory.spines["right"].set_visible(True)
    memory.plot(count, [r["bytes_per_robot"] / 1e3 for r in robots["rows"]], "s--", color="C1", label="memory")
    memory.axhline(robots["needed_bytes_per_robot"] / 1e3, color="C1", alpha=0.5, linestyle=":", label="memory needed")
    memory.set_ylabel("memory per robot [kB]")
    memory.set_ylim(bottom=0)
    ax.figure.legend(handles=[ax.lines[0], *memory.lines], loc="outside lower left", ncols=3)


def _draw_cells(ax: Axes, result: dict[str, Any]) -> None:
    """Draw time against cells."""
    rows = result["cells"]["rows"]
    ax.plot([r["cells"] for r in rows], [r["median"] for r in rows], "o-")
    ax.set(xscale="log", yscale="log", xlabel="cells", ylabel="time per update [ms]")
    ax.set_title(f"{result['cells']['points']:,} points; exponent {result['cells']['exponent']:.2f}")
    _plain_ticks(ax.yaxis)


def _draw_rays(ax: Axes, result: dict[str, Any]) -> None:
    """Draw time against ray length."""
    rows = result["rays"]["rows"]
    ax.plot([r["metres"] for r in rows], [r["median"] for r in rows], "o-")
    ax.set(xlabel="length of half of the rays [m];\nthe window ends at 5 m", ylabel="time per update [ms]")
    ax.set_title(f"{result['rays']['points']:,} points; exponent {result['rays']['exponent']:.2f}")
    ax.set_ylim(0, 1.2 * max(r["median"] for r in rows))
