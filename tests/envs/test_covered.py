"""TerrainNav below and beside boxes: what ends an episode, and what robots see of ceilings."""

import dataclasses

import pytest
import torch

from envs.terrain_nav import SightConfig, TerrainNav, TerrainNavConfig
from envs.terrain_nav.robot import Ground
from tests.envs.terrain_nav_cases import FLAT, SMALL
from torchelev.sim import CoversConfig, Structures
from torchelev.sim.terrains.parts import beam, placed
from training.nav.covered import covered_sight
from training.nav.evaluate import evaluate, straight_line

COVERED = dataclasses.replace(SMALL, covers=CoversConfig())


def below(height, y=0.0):
    """Return a task of one robot at the origin of flat ground, 1 m before a beam of 0.4 m at `height` [m]."""
    task = TerrainNav(TerrainNavConfig(course=FLAT), 1, perception="blind")
    structures = Structures.of_tiles([placed(beam(height, length=0.4), 1.0, y)])
    task.course = dataclasses.replace(task.course, structures=structures)
    task.ground = Ground(task.course.field, task.cfg.robot.reach, structures)
    for name, value in {"xy": (0.0, 0.0), "goal": (3.0, 0.0)}.items():
        getattr(task, name).copy_(torch.tensor([value]))
    task.yaw.zero_()
    return task


def run(task):
    for _ in range(40):
        outcome = task.advance(torch.tensor([[1.0, 0.0]]))
        if bool(outcome.done):
            return outcome
    raise AssertionError("the episode goes on")


def test_a_body_that_meets_a_beam_falls():
    task = below(0.5)
    outcome = run(task)
    assert bool(outcome.bumped) and bool(outcome.fallen) and bool(task.info(outcome)["bumped"])
    assert 0.5 < float(task.xy[0, 0]) < 0.66, "its front is at the beam"
    assert float(outcome.reward) < -4.5
    task.reset(outcome.done)
    assert not bool(task.bumped.any())


@pytest.mark.parametrize("height, y", [(0.61, 0.0), (0.5, 0.41)])
def test_robots_pass_under_and_beside(height, y):
    outcome = run(below(height, y))
    assert bool(outcome.success) and not bool(outcome.bumped)


def test_pixels_in_which_voxels_do_not_fit_need_no_voxels():
    sight = SightConfig(crop_length=3.0, crop_resolution=0.25)
    task = TerrainNav(TerrainNavConfig(course=FLAT, sight=sight), 1)
    assert task.observe()["map"].shape == (1, 4, 12, 12)
    with pytest.raises(ValueError, match="length_z: must be a whole number of times 0.125 m"):
        TerrainNav(TerrainNavConfig(course=FLAT, sight=dataclasses.replace(sight, ceilings="voxels")), 1)


def test_open_courses_have_no_bumps():
    task = TerrainNav(TerrainNavConfig(course=FLAT), 2, perception="blind")
    outcome = task.advance(torch.ones(2, 2))
    assert not bool(outcome.bumped.any()) and "bumped" not in task.info(outcome)
    assert task.observe()["truth"].shape == (2, 4, 16, 16)


@pytest.mark.slow(2)
@pytest.mark.parametrize("ceilings, channels", [("none", 4), ("scan", 6), ("drop", 6), ("voxels", 16)])
def test_images_have_the_channels_of_their_ceilings(ceilings, channels):
    task = TerrainNav(TerrainNavConfig(course=COVERED, sight=covered_sight("base", ceilings)), 3)
    blind = TerrainNav(TerrainNavConfig(course=COVERED, sight=covered_sight("base", ceilings)), 3, perception="blind")
    for _ in range(3):
        task.advance(torch.ones(3, 2))
        task.sense()
        seen = task.observe()
        assert seen["map"].shape == blind.observe()["map"].shape == (3, channels, 16, 16)
        assert seen["truth"].shape == (3, 6, 16, 16)
        assert all(bool(value.isfinite().all()) for value in seen.values())
    assert (task.sight.emap.levels is not None) == (ceilings != "none")


@pytest.mark.slow(1)
def test_true_ceilings_are_those_of_the_boxes():
    cfg = TerrainNavConfig(course=COVERED, sight=SightConfig(ceilings="scan", truth_noise=0.0))
    task = TerrainNav(cfg, 16, perception="truth")
    seen = task.observe()
    assert torch.equal(seen["map"], seen["truth"])
    xy = task.truth.crop.xy(task.T_map_base)
    ground = task.course.field.height(task.tile_ids, xy)
    ceiling = task.course.structures.underside(task.tile_ids, xy, ground) - task.T_map_base[:, 2, 3, None]
    error = (seen["truth"][:, 4].flatten(1) - ceiling.clamp(max=cfg.sight.no_ceiling)).abs()
    assert float((error > 0.05).float().mean()) < 0.05, "only at the rims of boxes, which lie between samples"
    assert float((ceiling < 0.5).float().mean()) > 0.03


@pytest.mark.slow(2)
def test_a_drop_is_the_scan_counted_downwards():
    images = {}
    for ceilings in ("scan", "drop"):
        sight = dataclasses.replace(covered_sight("base", ceilings), sensor_errors="perfect", pose_errors="perfect")
        task = TerrainNav(TerrainNavConfig(course=COVERED, sight=sight), 16, seed=3)
        for _ in range(3):
            task.advance(torch.ones(16, 2))
            task.sense()
        images[ceilings] = task.observe()["map"]
    assert float(images["drop"][:, 4].max()) > 0.1, "something hangs"
    assert torch.allclose(images["drop"][:, 4], sight.no_ceiling - images["scan"][:, 4])
    assert torch.equal(images["drop"][:, 5], images["scan"][:, 5])


@pytest.mark.slow(2)
def test_the_map_sees_ceilings_where_they_are():
    sight = dataclasses.replace(covered_sight("base", "scan"), sensor_errors="perfect", pose_errors="perfect")
    task = TerrainNav(TerrainNavConfig(course=COVERED, sight=sight), 32, seed=3)
    for _ in range(6):
        task.advance(torch.tensor([[0.4, 0.0]]).expand(32, 2))
        task.sense()
    seen = task.observe()
    is_seen = (seen["map"][:, 5] > 0) & (seen["map"][:, 4] < 0.9)
    error = (seen["map"][:, 4] - seen["truth"][:, 4])[is_seen].abs()
    assert int(is_seen.sum()) > 50 and float(error.median()) < 0.05


def test_bad_ceilings_are_refused():
    with pytest.raises(
        ValueError, match="sight.ceilings: must be one of none, scan, drop, voxels, got 'all'; use none"
    ):
        SightConfig(ceilings="all")
    cfg = TerrainNavConfig(course=FLAT, sight=SightConfig(ceilings="voxels"))
    with pytest.raises(ValueError, match="sight.ceilings: must be none or scan for the truth"):
        TerrainNav(cfg, 1, perception="truth")


@pytest.mark.slow(1)
def test_the_evaluation_counts_bumps_among_falls():
    cfg = TerrainNavConfig(course=COVERED, sight=covered_sight("base", "none"))
    result = evaluate(straight_line, cfg, "blind", episodes=64)
    assert 0 < result["bumped"] <= result["fallen"] and result["success"] < 0.5


@pytest.mark.slow(1)
def test_pictures_show_which_boxes_are_too_low():
    from envs.terrain_nav.render import draw, snapshot

    for height, counts in ((0.5, (1, 0)), (0.7, (0, 1))):
        task = below(height)
        shot = snapshot(task)
        assert (len(shot.low), len(shot.high)) == counts and draw(task, 0).ndim == 3
        outline = torch.as_tensor([*shot.low, *shot.high][0])
        assert outline.amin(0).tolist() == pytest.approx([0.95, -0.2])
        assert outline.amax(0).tolist() == pytest.approx([1.05, 0.2])
    assert not len(snapshot(TerrainNav(TerrainNavConfig(course=FLAT), 1, perception="blind")).low)
