"""Labelled maps: labels lie where the cells are, seeds decide everything, files are kept."""

import dataclasses
import math

import numpy as np
import pytest
import torch

import training.traversability.maps.data as data
from tests.helpers import pose
from tests.training.traversability.small import TINY
from torchelev.robot import RobotConfig
from torchelev.sim import HeightField
from training.traversability.maps.data import batch_seed, data_set, label_cells, make_batch, rated_cells
from training.traversability.maps.mapping import (
    blank_map,
    tile_cell_centers,
    walk_and_map,
)
from training.traversability.maps.terrain import (
    KINDS,
    LENGTH,
    RESOLUTION,
    UNSEEN_KINDS,
)

BOX = (0.8, 1.1, -0.4, -0.1)  # [m] x from, to, y from, to: too small to stand on

SMALL = TINY(looks=(3, 3))


def flat_tile_with_a_box(height=0.8):
    axis = (torch.arange(401) - 200) * RESOLUTION
    x, y = axis[:, None], axis[None]
    inside = (x >= BOX[0]) & (x <= BOX[1]) & (y >= BOX[2]) & (y <= BOX[3])
    return HeightField((inside * height)[None], RESOLUTION)


def from_box(xy):
    """Distance [m] of places (..., 2) from the box."""
    x, y = xy.unbind(-1)
    dx = (BOX[0] - x).clamp(min=0) + (x - BOX[1]).clamp(min=0)
    dy = (BOX[2] - y).clamp(min=0) + (y - BOX[3]).clamp(min=0)
    return torch.hypot(dx, dy)


@pytest.mark.slow(1)
@pytest.mark.parametrize("seed", [0, 3])
def test_labels_lie_where_the_map_has_the_ground_that_they_are_of(seed):
    # The robot starts off the middle and turned, in a map frame that is shifted and turned against the tile.
    path = torch.stack([pose((-0.5 + 0.1 * k, -1.2 + 0.1 * k, 0.5), yaw=0.9) for k in range(8)])
    field, robot, rng = flat_tile_with_a_box(), RobotConfig(length=0.6, width=0.4), np.random.default_rng(seed)
    cfg = dataclasses.replace(SMALL, num_maps=1, window=4.0, camera_pixels=(64, 48), lidar_rays=(32, 256))
    emap, T_tile_map = walk_and_map(field, robot, 0.05, cfg, rng, path)
    maps = label_cells(emap, T_tile_map, field, robot, 4, ("box",))
    ground = float(maps.elevation[maps.validity].median())
    high = maps.validity & (maps.elevation > ground + 0.3)
    assert int(high.sum()) > 10, "the robot sees the box"
    distance = from_box(tile_cell_centers(emap, T_tile_map))
    # Some points fly between the box and what is behind it.
    assert float(distance[high].median()) < 0.05 and float((distance[high] < 0.15).float().mean()) > 0.75
    assert float(maps.label[high & maps.rated].median()) < 0.5
    away = maps.rated & (distance > math.hypot(0.3, 0.2) + robot.foot_reach + 0.1)
    assert int(away.sum()) > 500 and float(maps.label[away].amin()) == 1.0
    assert float(maps.label[maps.rated & (distance == 0)].amax()) == 0.0


def test_rated_cells_equal_a_loop():
    rng = np.random.default_rng(0)
    validity, bounded = (torch.from_numpy(rng.random((2, 15, 12)) < share) for share in (0.02, 0.1))
    rated = rated_cells(validity, bounded, 0.1)
    for b, i, j in np.ndindex(2, 15, 12):
        near = bool(validity[b, max(0, i - 3) : i + 4, max(0, j - 3) : j + 4].any())
        assert bool(rated[b, i, j]) == (near or bool(bounded[b, i, j]))
    assert not rated_cells(torch.zeros_like(validity), torch.zeros_like(bounded), 0.1).any()


def test_cells_beyond_the_tile_are_not_rated():
    field, robot = flat_tile_with_a_box(), RobotConfig()
    emap = blank_map(0.1, 4.0, 1)
    T = pose((LENGTH / 2, 0.0, 0.0))
    emap.update(torch.full((1, 1, 3), torch.nan), T, T, dt=0.0)
    emap.state.validity.fill_(True)
    rated = label_cells(emap, pose((0.0, 0.0, 0.0)), field, robot, 2, ("box",)).rated
    x = emap.cell_centers()[..., 0]
    assert torch.equal(rated, x <= LENGTH / 2) and rated.any() and not rated.all()


def equal(a, b):
    tensors = all(torch.equal(x, y) for x, y in zip(a[:7], b[:7], strict=True))
    return tensors and a[7:] == b[7:]


@pytest.mark.slow(3)
def test_a_seed_makes_the_same_maps_and_another_makes_others():
    first = make_batch([0, 1], SMALL)
    assert equal(first, make_batch([0, 1], SMALL)) and not equal(first, make_batch([0, 2], SMALL))
    H = round(2.0 / first.resolution)
    assert first.elevation.shape == first.label.shape == (2, H, H) and len(first.kinds) == 2
    assert set(first.kinds) <= set(KINDS) and 0.02 <= first.resolution <= 0.1
    assert first.rated.any() and (first.validity.any((1, 2))).all()
    for layer in (first.elevation, first.variance, first.upper_bound, first.label):
        assert layer.isfinite().all()
    assert float(first.label.amin()) >= 0 and float(first.label.amax()) <= 1
    assert float(first.label[~first.rated].abs().sum()) == 0


@pytest.mark.slow(1)
def test_kinds_resolution_and_robot_can_be_fixed():
    robot = RobotConfig(length=0.5, width=0.3)
    maps = make_batch(5, dataclasses.replace(SMALL, robot=robot), UNSEEN_KINDS, 0.08)
    assert maps.kinds == ("stepping_stones",) * 2 and maps.resolution == 0.08 and maps.robot == robot
    assert not set(UNSEEN_KINDS) & set(KINDS)


@pytest.mark.slow(2)
def test_exact_batches_are_rated_everywhere(tmp_path):
    (maps,) = data_set(tmp_path, "held_out_exact", 1, 0, SMALL, resolution=0.1)
    assert maps.validity.all() and maps.rated.all()
    assert equal(maps, make_batch(batch_seed("held_out_exact", 0, 0), SMALL, KINDS, 0.1, exact=True))


def test_splits_and_data_sets_have_seeds_of_their_own():
    seeds = {tuple(batch_seed(split, seed, k)) for split in data.SPLITS for seed in range(3) for k in range(3)}
    assert len(seeds) == len(data.SPLITS) * 9


@pytest.mark.slow(2)
def test_a_data_set_is_kept_and_only_what_lacks_is_made(tmp_path):
    first = data_set(tmp_path, "train", 1, 0, SMALL, resolution=0.1)
    (path,) = tmp_path.iterdir()
    written = path.stat().st_mtime_ns
    again = data_set(tmp_path, "train", 2, 0, SMALL, resolution=0.1)
    assert path.stat().st_mtime_ns == written and len(list(tmp_path.iterdir())) == 2
    assert equal(first[0], again[0]) and not equal(first[0], again[1])
    assert equal(again[1], make_batch(batch_seed("train", 0, 1), SMALL, KINDS, 0.1))
    other = dataclasses.replace(SMALL, headings=3)
    with pytest.raises(ValueError, match=r"must be of the same settings, got other headings; remove the folder"):
        data_set(tmp_path, "train", 1, 0, other, resolution=0.1)
    assert not list(tmp_path.glob("*.tmp"))
