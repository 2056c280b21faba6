"""The demo runs, writes its picture and says how good the map is."""

import numpy as np
import pytest
import torch

pytest.importorskip("matplotlib")
pytest.importorskip("tqdm")

from torchelev.app.demo import DT, run
from torchelev.app.demo.course import LANDMARKS, ROUTE, make_course
from torchelev.sim import DepthCamera
from torchelev.viz import style


def run_demo(out, seconds):
    """Keep the test short: a camera of few pixels."""
    return run.run_demo(out, seconds, progress=False, camera=DepthCamera(width=40, height=30, max_range=6.0))


@pytest.mark.slow(2)
def test_demo_maps_draws_and_measures(tmp_path):
    out = tmp_path / "demo.png"
    printed = str(run_demo(out, seconds=2))
    assert out.read_bytes().startswith(b"\x89PNG")
    for word in ("RMSE", "p95", "coverage", "ms per update"):
        assert word in printed


@pytest.mark.slow(1)
def test_result_is_that_of_a_map_of_the_course(tmp_path):
    result = run_demo(tmp_path / "a.png", seconds=2)
    assert result.updates == round(2 / DT)
    # Few pixels, one in a hundred wrong, a person in view: the map can only be roughly right so early.
    assert result.p95 < 0.15 and result.coverage > 0.95


@pytest.mark.slow(2)
def test_labels_touch_neither_the_path_nor_each_other(tmp_path, figures):
    run_demo(tmp_path / "a.png", seconds=0.4)
    ax = figures[0].axes[0]
    figures[0].canvas.draw()
    boxes = [text.get_bbox_patch().get_window_extent() for text in ax.texts]
    assert len(boxes) == len(LANDMARKS)
    assert not any(a.overlaps(b) for k, a in enumerate(boxes) for b in boxes[:k])
    corners = np.array(ROUTE)
    fraction = np.linspace(0, 1, 200)[:, None]
    path = np.concatenate([a + fraction * (b - a) for a, b in zip(corners[:-1], corners[1:], strict=True)])
    pixels, line = ax.transData.transform(path), 2.4 / 72 * figures[0].dpi
    assert not any(box.padded(line / 2).contains(x, y) for box in boxes for x, y in pixels)


@pytest.mark.slow(2)
def test_an_svg_is_small_and_always_the_same(tmp_path):
    for name in ("a.svg", "b.svg"):
        run_demo(tmp_path / name, seconds=0.4)
    first, second = ((tmp_path / name).read_bytes() for name in ("a.svg", "b.svg"))
    assert first == second and first.count(b"<svg") == 1 and len(first) < style.MAX_BYTES


def test_finds_the_cells_at_steps():
    scene = make_course()
    xy = torch.tensor([[[0.0, 0.413], [0.0, -0.2]]], dtype=torch.float64)
    assert run.find_steps(scene, xy, 0.0).tolist() == [[True, False]]


@pytest.mark.parametrize(
    "options, words",
    [
        (["--seconds", "nan"], "seconds: must be positive, got nan"),
        (["--seconds", "-5"], "seconds: must be positive, got -5.0"),
        (["--out", "d.xyz"], "must be a picture, got one of suffix .xyz"),
        (["--out", "nowhere/d.png"], "there is no folder"),
    ],
)
def test_bad_options_are_one_line_before_the_walk(options, words, tmp_path, monkeypatch):
    from click.testing import CliRunner

    from torchelev.app.cli import main

    monkeypatch.chdir(tmp_path)
    done = CliRunner().invoke(main, ["demo", *options])
    assert done.exit_code == 2 and words in done.output and done.output.count("\n") == 1
    assert "walking" not in done.output, "as the progress bar says"
