"""Pictures of the quadruped; skipped, with the reason, where MuJoCo finds no OpenGL."""

import numpy as np
import pytest
import torch

from envs.quadruped import Quadruped, render
from tests.envs.quadruped.cases import CFG


@pytest.fixture(scope="module")
def task():
    task = Quadruped(CFG, 2, perception="map", seed=1)
    for _ in range(8):
        task.advance(torch.zeros(2, 12))
        task.sense()
    try:
        render.draw(task)
    except RuntimeError as error:
        pytest.skip(str(error))
    return task


@pytest.mark.slow(2)
def test_a_picture_shows_robot_and_map(task):
    picture = render.draw(task, 1)
    assert picture.shape == (360, 480, 3) and picture.dtype == np.uint8
    task.sight.emap.reset()
    without = render.draw(task, 1)
    changed = (picture.astype(int) - without).any(-1).mean()
    assert 0.02 < changed < 0.9, "only the cells of the map have gone"
    task.advance(torch.zeros(2, 12))
    assert (render.draw(task, 1) != without).any()


@pytest.mark.slow(1)
def test_strip_and_video_are_written(task, tmp_path):
    pictures = [np.full((20, 30, 3), k, np.uint8) for k in range(0, 100, 10)]
    render.save_strip(pictures, tmp_path / "strip.png")
    render.save_video(pictures, tmp_path / "walk.webp")
    assert (tmp_path / "strip.png").stat().st_size > 0 and (tmp_path / "walk.webp").stat().st_size > 0
    with pytest.raises(ValueError, match="pictures: must not be empty"):
        render.save_strip([], tmp_path / "none.png")


def test_without_opengl_the_error_says_why(monkeypatch):
    def refuse(*args, **kwargs):
        raise RuntimeError("no display")

    monkeypatch.setattr(render.mujoco, "Renderer", refuse)
    with pytest.raises(RuntimeError, match="finds no OpenGL .no display.; without a screen install libegl1"):
        render.open_renderer(None)
