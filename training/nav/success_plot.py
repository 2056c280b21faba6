"""The figure of experiments that compare policies: success during training, and when deployed."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from torchelev.viz.style import make_figure, styled, write


@styled()
def draw_success(result: dict[str, Any], key: str, names: Mapping[str, str], title: str, path: Path) -> None:
    """Draw the success of each training, coloured by what is compared.

    Args:
        result: of an experiment; `rows` hold the key, "seed", "curve" and "deployed".
        key: what is compared.
        names: of its values, in the order of the figure.
        title: of the values' axis.
        path: of the figure.
    """
    figure, values = make_figure(8, 4.2), list(names)
    left, right = figure.subplots(1, 2, sharey=True, width_ratios=(1.5, 1))
    for row in result["rows"]:
        place = values.index(row[key])
        label = names[row[key]] if row["seed"] == result["config"]["seeds"][0] else None
        left.plot(*row["curve"].values(), color=f"C{place}", linewidth=1.2, label=label)
        right.plot(place, row["deployed"]["success"], "o", color=f"C{place}")
    left.set(xlabel="environment steps", ylabel="success", title="while training", ylim=(0, 1))
    left.legend(loc="lower right")
    left.xaxis.set_major_formatter(lambda steps, _: f"{steps / 1e3:,.0f}k")
    right.set(title="on held-out ground", ylim=(0, 1), xlim=(-0.4, len(values) - 0.6), xlabel=title)
    right.set_xticks(range(len(values)), list(names.values()))
    write(figure, path)
