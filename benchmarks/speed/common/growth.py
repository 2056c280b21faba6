"""Whether the time, the memory or the number of compiled graphs grew over a long run: table and figure."""

from __future__ import annotations

import math
import statistics
from pathlib import Path
from typing import Any

from matplotlib.ticker import MaxNLocator

from torchelev.app.results import markdown_table
from torchelev.viz.style import make_figure, styled, write

GROWTH = 1.05  # largest ratio of the last quarter to the first, and of the old process to a new one


def _growth(series: list[float]) -> float:
    """Return the median of the last quarter divided by that of the first."""
    part = max(1, len(series) // 4)
    return statistics.median(series[-part:]) / statistics.median(series[:part])


def _ratios(times: list[float], others: list[float]) -> list[float]:
    """Divide each time by the one that was measured next to it."""
    return [time / other for time, other in zip(times, others, strict=True)]


def verdicts(result: dict[str, Any]) -> list[list[str]]:
    """Return a row per case: growth of time and memory, graphs compiled, verdict."""
    rows = []
    for name, values in result.items():
        time, memory = _growth(values["ms"]), _growth(values["resident_bytes"])
        paired = _growth(_ratios(values["ms"], values["reference_ms"]))
        beside = statistics.median(_ratios(values.get("old_ms", []), values.get("new_ms", [])) or [math.nan])
        graphs = values["graphs"][-1]
        holds = max(paired, beside, memory) <= GROWTH and graphs == values["graphs"][0]
        figures = [f"{time:.2f}", f"{paired:.2f}", f"{beside:.2f}", f"{memory:.3f}", f"{graphs}"]
        verdict = "none grows" if holds else "GROWS"
        is_complete = len(values["ms"]) >= 10 and beside > 0
        rows.append([name, f"{values['updates']:,}", *figures, verdict if is_complete else "too short"])
    return rows


def table(result: dict[str, Any]) -> str:
    """Tabulate the cases."""
    beside = ["time over a reference's", "time over a new process's"]
    head = ["case", "updates", "time alone", *beside, "memory", "graphs compiled", ""]
    return markdown_table(head, verdicts(result))


@styled()
def plot(result: dict[str, Any], path: Path) -> None:
    """Draw the time per update and the memory over the updates."""
    figure = make_figure(8, 3.9)
    axes = figure.subplots(1, len(result), squeeze=False)
    for ax, (name, values) in zip(axes.flat, result.items(), strict=True):
        updates = [values["block"] * (k + 1) for k in range(len(values["ms"]))]
        ax.plot(updates, values["ms"], linewidth=1.2, label="time")
        ax.plot(updates, values["reference_ms"], color="C0", alpha=0.4, linewidth=1.2, label="time of a reference")
        ax.set(xlabel="updates", ylabel="time per update [ms]", title=name)
        ax.set_ylim(bottom=0)
        memory = ax.twinx()
        memory.spines["right"].set_visible(True)
        ax.xaxis.set_major_locator(MaxNLocator(4))
        ax.xaxis.set_major_formatter(lambda updates, _: f"{updates:,.0f}")
        memory.plot(updates, [b / 1e6 for b in values["resident_bytes"]], color="C1", label="memory")
        memory.set_ylabel("memory of the process [MB]")
        memory.set_ylim(0, 1.3e-6 * max(values["resident_bytes"]))
    handles = [*ax.lines, *memory.lines]
    figure.legend(handles=handles, loc="outside lower center", ncols=len(handles))
    write(figure, path)
