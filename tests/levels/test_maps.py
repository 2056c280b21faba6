"""Maps with levels: one level, saving, resets, several environments, places far away, and errors."""

import copy

import pytest
import torch

from tests.levels.walks import GRID, at, line, look, make_map, walk
from torchelev import ElevationMap, ElevationMapConfig, GridConfig, LevelsConfig
from torchelev.levels.state import Levels
from torchelev.sim.exact import covered_scenes

TABLE = covered_scenes.table()
PLACES = line((0.0, 0.0, 0.0), (1.5, 0.0, 0.0), 5)


@pytest.fixture(scope="module")
def walked():
    emap = make_map()
    walk(emap, TABLE, PLACES)
    return emap


def require_same(a, b):
    for name in Levels._fields:
        assert torch.equal(getattr(a.levels, name), getattr(b.levels, name)), name
    for layer in ("elevation", "variance", "ceiling", "traversability"):
        torch.testing.assert_close(a.layer(layer), b.layer(layer), rtol=0, atol=0, equal_nan=True)


def test_one_level_is_a_map_without():
    one = make_map(levels=LevelsConfig(max_levels=1))
    plain = ElevationMap(ElevationMapConfig(grid=GRID))
    assert one.levels is None
    for emap in (one, plain):
        walk(emap, TABLE, PLACES[:3])
    for name in plain.layers:
        assert torch.equal(one.layer(name).nan_to_num(-7), plain.layer(name).nan_to_num(-7))


def test_the_order_of_points_does_not_matter(walked):
    other = make_map()
    for k, place in enumerate(PLACES):
        points, *poses = look(TABLE, *place, seed=k)
        order = torch.randperm(points.shape[1], generator=torch.Generator().manual_seed(k))
        other.update(points[:, order], *poses, dt=0.2)
    for name in Levels._fields:
        torch.testing.assert_close(getattr(walked.levels, name), getattr(other.levels, name), rtol=0, atol=1e-5)


def test_each_map_of_a_batch_is_as_if_alone(walked):
    batch = make_map(3)
    for k, place in enumerate(PLACES):
        points, T_map_sensor, T_map_base = look(TABLE, *place, seed=k)
        nothing = torch.full_like(points, torch.nan)
        clouds, sensors, bases = [nothing, points, points], T_map_sensor.repeat(3, 1, 1), T_map_base.repeat(3, 1, 1)
        batch.update(torch.cat(clouds), sensors, bases, dt=0.2)
    for name in Levels._fields:
        for b in (1, 2):
            assert torch.equal(getattr(batch.levels, name)[b], getattr(walked.levels, name)[0])
    assert not batch.levels.support[0].any()


@pytest.mark.parametrize("away", [(0.7, -1.3, 0.0), (100_000.0, -50_000.0, 12.0)])
def test_a_map_elsewhere_is_the_same(walked, away):
    other, shift = make_map(), torch.tensor(away, dtype=torch.float64)
    for k, place in enumerate(PLACES):
        points, T_map_sensor, T_map_base = look(TABLE, *place, seed=k)
        for pose in (T_map_sensor, T_map_base):
            pose[:, :3, 3] += shift
        other.update(points, T_map_sensor, T_map_base, dt=0.2)
    same = (walked.layer("ceiling") - (other.layer("ceiling") - away[2])).abs() < 1e-3
    same |= walked.layer("ceiling") == other.layer("ceiling")
    same |= walked.layer("ceiling").isnan() & other.layer("ceiling").isnan()
    assert same.float().mean() > 0.99


def test_a_saved_map_goes_on_as_if_nothing_happened(walked):
    here, there = copy.deepcopy(walked), make_map()
    there.load_state_dict(copy.deepcopy(walked.state_dict()))
    for emap in (here, there):
        emap.update(*look(TABLE, 1.7, 0.0, seed=77), dt=0.2)
    require_same(here, there)


def test_a_checkpoint_with_other_levels_is_refused(walked):
    other = make_map(levels=LevelsConfig(max_levels=4))
    with pytest.raises(ValueError, match=r"levels\.max_levels"):
        other.load_state_dict(walked.state_dict())
    with pytest.raises(ValueError, match="levels"):
        ElevationMap(ElevationMapConfig(grid=GRID)).load_state_dict(walked.state_dict())


def test_a_reset_forgets_levels(walked):
    emap = make_map(2)
    points, *poses = look(TABLE, 1.0, 0.0)
    emap.update(points.repeat(2, 1, 1), *(pose.repeat(2, 1, 1) for pose in poses), dt=0.1)
    emap.reset(torch.tensor([1]))
    assert emap.levels.support[0].any()
    assert not emap.levels.support[1].any()
    assert emap.layer("ceiling")[1].isnan().all()


def test_clearing_around_a_place_forgets_its_levels(walked):
    emap = copy.deepcopy(walked)
    emap.clear_around(torch.tensor([[2.0, 0.0]]), 0.3)
    assert torch.isnan(torch.tensor(at(emap, "ceiling", 2.0, 0.0)))
    assert at(emap, "ceiling", 1.5, 0.3) == pytest.approx(0.74, abs=0.03)


def test_levels_keep_their_place_when_the_window_moves(walked):
    emap = copy.deepcopy(walked)
    nothing = torch.full((1, 1, 3), torch.nan)
    for x in (2.5, 1.5):
        _, T_map_sensor, T_map_base = look(TABLE, x, 0.3)
        emap.update(nothing, T_map_sensor, T_map_base, dt=0.0)
    assert at(emap, "ceiling", 2.0, 0.0) == pytest.approx(0.74, abs=0.03)


def test_sampling_a_ceiling_takes_the_lowest_cell(walked):
    values, valid = walked.sample(torch.tensor([[[1.9, 0.0], [0.5, 1.5], [1.2, 0.0]]]), "ceiling")
    assert valid.all()
    assert values[0, 0] == pytest.approx(0.74, abs=0.02)
    assert values[0, 1] == torch.inf
    assert values[0, 2] < 1.0


def test_config_survives_a_file(tmp_path):
    cfg = ElevationMapConfig(
        grid=GridConfig(length_x=2.0, length_y=2.0), levels=LevelsConfig(max_levels=2, min_gap=0.7)
    )
    cfg.save(tmp_path / "map.json")
    assert ElevationMapConfig.load(tmp_path / "map.json") == cfg
    assert "levels" not in ElevationMapConfig().to_dict()


@pytest.mark.parametrize(
    ("settings", "words"),
    [
        ({"max_levels": 0}, r"levels\.max_levels: must be a whole number from 1 to 8, got 0"),
        ({"max_levels": 100}, r"levels\.max_levels: must be a whole number from 1 to 8"),
        ({"max_levels": 2.0}, "whole number"),
        ({"min_gap": 0.0}, r"levels\.min_gap"),
        ({"min_gap": 400.0}, r"levels\.min_gap: must be at most 20 m, got 400.0; give metres"),
        ({"max_step": -1.0}, r"levels\.max_step"),
        ({"separation": "hope"}, r"levels\.separation: must be one of rays, gap"),
        ({"max_blind": float("nan")}, r"levels\.max_blind"),
        ({"min_support": -1}, r"levels\.min_support"),
    ],
)
def test_bad_settings_are_refused(settings, words):
    with pytest.raises(ValueError, match=words):
        LevelsConfig(**settings)


def test_layers_of_levels_need_levels(walked):
    plain = ElevationMap(ElevationMapConfig(grid=GRID))
    with pytest.raises(KeyError, match="LevelsConfig"):
        plain.layer("ceiling")
    with pytest.raises(ValueError, match="LevelsConfig"):
        plain.layer("elevation", level=0)
    with pytest.raises(ValueError, match="from 0, the lowest, to 2"):
        walked.layer("elevation", level=3)
    with pytest.raises(KeyError, match="underside"):
        walked.layer("traversability", level=0)
