"""The moving picture: a walk on the ground, maps that grow, tiles, and a film of the right size."""

import numpy as np
import pytest

pytest.importorskip("scipy")
pytest.importorskip("matplotlib")

from docs.moving_picture import batch, walk
from docs.moving_picture.legs import leg_joints
from torchelev.sim import DepthCamera


@pytest.fixture(scope="module")
def path():
    return walk.Path(walk.make_ground())


@pytest.fixture
def small(monkeypatch):
    """Keep the tests short: a camera of few pixels and large cells."""
    monkeypatch.setattr(walk, "CAMERA", DepthCamera(width=40, height=30, max_range=4.5))
    monkeypatch.setattr(walk, "GRID", walk.GridConfig(resolution=0.1, length_x=12.0, length_y=9.6))


def test_the_body_keeps_its_height_and_moves_smoothly(path):
    times = np.linspace(0, path.seconds, 200)
    bases = np.array([path.base(t) for t in times])
    over_ground = bases[:, 2, 3] - path.ground(bases[:, :2, 3])
    assert 0.25 < over_ground.min() and over_ground.max() < 0.65
    speed = np.linalg.norm(np.diff(bases[:, :3, 3], axis=0), axis=1) / np.diff(times)
    assert speed.max() < 1.4 * walk.SPEED


@pytest.mark.slow(1)
def test_legs_have_links_of_one_length_and_two_feet_stand_at_all_times(path):
    for t in np.linspace(0.5, path.seconds - 0.5, 40):
        joints = leg_joints(path, t)
        feet = np.array([foot for _, _, foot in joints])
        standing = np.abs(feet[:, 2] - path.ground(feet[:, :2])) < 1e-6
        assert standing.sum() >= 2
        for hip, knee, foot in joints:
            assert np.linalg.norm(knee - hip) == pytest.approx(np.linalg.norm(foot - knee), abs=1e-9)
            assert 0.25 < np.linalg.norm(knee - hip) < 0.36


def test_a_standing_foot_does_not_slide(path):
    before, after = leg_joints(path, 1.30), leg_joints(path, 1.32)
    fixed = [np.linalg.norm(a[2] - b[2]) < 1e-9 for a, b in zip(before, after, strict=True)]
    assert sum(fixed) >= 2


@pytest.mark.slow(2)
def test_the_map_grows_and_the_view_ends_on_the_ground_or_at_its_range(path, small):
    moments = list(walk.walk(path, 5, 1.0))
    known = [np.isfinite(m.elevation).sum() for m in moments]
    assert len(moments) == 5 and known[-1] > known[0] > 50
    view = moments[0].view
    distance = np.linalg.norm(view - moments[0].T_map_sensor[:3, 3], axis=1)
    on_ground = np.abs(view[:, 2] - path.ground(view[:, :2])) < 0.02
    assert distance.max() < walk.VIEW_RANGE + 1e-6
    assert (on_ground | (distance > walk.VIEW_RANGE - 1e-3)).mean() > 0.8  # others end on vertical faces


@pytest.mark.slow(3)
def test_sixteen_maps_differ_and_grow():
    frames = list(batch.walk_in_circles(batch.make_tiles(), 3, 5))
    first, last = frames[0][0], frames[-1][0]
    assert first.shape == (16, 96, 96)
    assert (np.isfinite(last).sum((1, 2)) > np.isfinite(first).sum((1, 2))).mean() > 0.8
    assert len({round(float(np.nanstd(heights)), 6) for heights in last}) == 16


@pytest.mark.slow(6)
def test_a_film_of_few_frames(tmp_path, small):
    pytest.importorskip("pyvista", reason="renders the picture; pip install 'torchelev[pictures]'")
    from PIL import Image

    from docs.moving_picture import film

    images = list(film.frames(0.2))
    assert [image.size for image in images] == 3 * [film.SIZE]
    stage = np.asarray(images[-1])[80:, : film.STAGE_SIZE[0] - 60]
    colorful = np.ptp(stage.astype(int), axis=-1) > 40
    assert 0.02 < colorful.mean() < 0.8, "map, robot and view cover a part of the stage"
    film.save_film(images, tmp_path / "walk.webp")
    loop = Image.open(tmp_path / "walk.webp")
    assert loop.size == film.FILM_SIZE and loop.n_frames == 2 + 3 and loop.info["loop"] == 0


def test_steps_have_vertical_faces_and_slopes_are_smooth():
    pytest.importorskip("pyvista", reason="makes the mesh; pip install 'torchelev[pictures]'")
    from docs.moving_picture.surface import surface

    xy = np.stack(np.meshgrid([0.0, 0.1, 0.2], [0.0, 0.1], indexing="ij"), -1)
    step = surface(xy, np.array([[0.0, 0.0], [0.3, 0.3], [np.nan, 0.3]]), 0.1)
    slope = surface(xy, np.array([[0.0, 0.0], [0.02, 0.02], [0.04, 0.04]]), 0.1)
    assert step.n_cells == 5 + 2, "five known cells, and the step's face beside each of two pairs"
    assert slope.n_cells == 6, "no faces between cells of one level"
