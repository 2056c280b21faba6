"""Figures drawn again from the committed results: files come out, and each panel has its data and units."""

from types import SimpleNamespace

import pytest
from PIL import Image

pytest.importorskip("rsl_rl")

import training
from benchmarks.quality.accuracy import report
from benchmarks.quality.features.comparison import FEATURES
from benchmarks.quality.features.feature_figure import ROWS
from benchmarks.speed.common import growth
from benchmarks.speed.update import plots
from docs.results import SPEED, load
from training.nav import experiment
from training.traversability import block


def draw_accuracy(path):
    report.plot(path, [SimpleNamespace(**row) for row in load("accuracy")["rows"]])


def draw_long_run(path):
    growth.plot({name: values for name, values in load("long_run").items() if name != "machine"}, path)


DRAW = {
    "accuracy": (draw_accuracy, 3),
    "long_run": (draw_long_run, 4),
    "nav": (lambda path: experiment.plot(load("nav", training.RESULTS), path), 2),
    "block": (lambda path: block.draw(load("block", training.RESULTS)["profiles"], path), 4),
}


@pytest.mark.slow(4)
@pytest.mark.parametrize("name", DRAW)
def test_a_figure_has_its_panels_with_data_and_labels(name, figures, tmp_path):
    draw, count = DRAW[name]
    draw(tmp_path / "figure.png")
    (figure,) = figures
    assert len(figure.axes) == count
    assert all(ax.has_data() for ax in figure.axes)
    assert all(ax.get_xlabel() for ax in figure.axes if ax.patch.get_visible() and not ax.get_ylabel())
    assert Image.open(tmp_path / "figure.png").size[0] >= 800


@pytest.mark.slow(3)
def test_speed_has_two_figures(figures, tmp_path):
    plots.draw(load(SPEED), tmp_path / "speed.png")
    names = [[ax.get_ylabel() or ax.get_xlabel() for ax in figure.axes] for figure in figures]
    assert "time per update [ms]" in names[0] and "time per robot [µs]" in names[1]
    assert sorted(path.name for path in tmp_path.iterdir()) == ["speed-scaling.png", "speed.png"]


def test_rows_of_the_features_name_measured_figures():
    measured = {(row["feature"], row["figure"]) for row in load("features")["rows"]}
    assert {(name, row.figure) for name, row in ROWS.items()} <= measured
    assert set(ROWS) <= {feature.name for feature in FEATURES}
