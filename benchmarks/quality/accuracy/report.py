"""The accuracy table and figure."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path

from benchmarks.quality.accuracy.score import Score, meets
from torchelev.app.results import markdown_table


def table(rows: Iterable[Score]) -> str:
    """Format the scores as a markdown table."""
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


def plot(path: Path, rows: list[Score]) -> None:
    """Draw the RMSE of the map beside that of the mean, with a panel for each motion."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(11, 4.2), layout="constrained")
    panels = figure.subplots(1, 3, sharex=True)
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
