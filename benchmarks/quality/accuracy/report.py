"""The accuracy table and figure."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path

from benchmarks.quality.accuracy.score import Score, meets
from torchelev.app.results import markdown_table
from torchelev.viz.style import make_figure, styled, write

_MOTIONS = {"turn": "camera, turning", "walk": "camera, walking", "lidar": "lidar"}


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


@styled()
def plot(path: Path, rows: list[Score]) -> None:
    """Draw the RMSE of the map beside that of the mean, with a panel for each motion."""
    figure = make_figure(8, 5)
    panels = figure.subplots(1, 3, sharex=True, sharey=True)
    for panel, motion in zip(panels, ("turn", "walk", "lidar"), strict=True):
        part = [r for r in rows if r.motion == motion][::-1]
        places = range(len(part))
        panel.barh([k + 0.2 for k in places], [max(r.rmse, 0.1) for r in part], 0.4, label="torchelev")
        panel.barh([k - 0.2 for k in places], [max(r.rmse_mean, 0.1) for r in part], 0.4, label="per-cell mean")
        panel.set(xscale="log", xlim=(0.05, 100), xlabel="RMSE [mm]", title=_MOTIONS[motion])
        panel.set_yticks(list(places), [f"{r.scene}, {r.noise}" for r in part])
        panel.grid(axis="x")
    handles, labels = panels[0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside lower center", ncols=2)
    write(figure, path)
