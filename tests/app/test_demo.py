"""The demo runs, writes its picture and says how good the map is."""

import pytest
import torch

pytest.importorskip("matplotlib")
pytest.importorskip("tqdm")

from torchelev.app import demo
from torchelev.app.demo_course import make_course


@pytest.fixture(autouse=True)
def small_camera(monkeypatch):
    """Keep the test short: a camera of few pixels."""
    monkeypatch.setattr(demo, "CAMERA", demo.DepthCamera(width=40, height=30, max_range=6.0))


@pytest.mark.slow(2)
def test_demo_maps_draws_and_measures(tmp_path):
    out = tmp_path / "demo.png"
    printed = str(demo.run_demo(out, seconds=2, progress=False))
    assert out.read_bytes().startswith(b"\x89PNG")
    for word in ("RMSE", "p95", "coverage", "ms per update"):
        assert word in printed


@pytest.mark.slow(1)
def test_result_is_that_of_a_map_of_the_course(tmp_path):
    result = demo.run_demo(tmp_path / "a.png", seconds=2, progress=False)
    assert result.updates == round(2 / demo.DT)
    # Few pixels, one in a hundred wrong, a person in view: the map can only be roughly right so early.
    assert result.p95 < 0.15 and result.coverage > 0.95


def test_finds_the_cells_at_steps():
    scene = make_course()
    xy = torch.tensor([[[0.0, 0.413], [0.0, -0.2]]], dtype=torch.float64)
    assert demo.find_steps(scene, xy, 0.0).tolist() == [[True, False]]
