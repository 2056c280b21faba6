"""Maps that follow control steps: how often they update, how they begin anew, and when terms share them."""

import gc
import weakref

import numpy as np
import pytest
import torch

from tests.integrations.simulators import CFG, Env, GroundSource
from torchelev.integrations.step_map import Cloud, StepMap, join, share_map, to_cloud


@pytest.fixture
def walking():
    """Three robots over ground at 0, 1 and 2 m, and their maps."""
    base = torch.tensor([[0.0, 0.0, 0.5], [10.0, 0.0, 1.5], [0.0, -10.0, 2.5]])
    env, source = Env(), GroundSource(base, torch.tensor([0.0, 1.0, 2.0]))
    return env, source, StepMap(env, source, CFG)


def known(maps):
    return maps.emap.layer("validity").sum((1, 2))


def clock(maps):
    """The time [s] that each map has seen pass."""
    return (maps.emap.state.elapsed / 1e9).tolist()


def start(env, maps):
    """What `env.reset()` does."""
    maps.reset(torch.arange(env.num_envs))
    maps.advance(env)


def test_nothing_is_read_before_the_first_reset_or_step(walking):
    env, source, maps = walking
    maps.advance(env)
    assert source.reads == 0 and maps.is_empty
    start(env, maps)
    assert source.reads == 1 and not maps.is_empty


def test_one_update_per_step_however_many_observations(walking):
    env, source, maps = walking
    start(env, maps)
    for step in range(1, 4):
        env.common_step_counter = step
        for _ in range(3):
            maps.advance(env)
        assert source.reads == 1 + step
    elevation = maps.emap.layer("elevation")
    for k in range(3):
        seen = elevation[k][elevation[k].isfinite()]
        assert len(seen) > 300 and (seen - k).abs().max() < 1e-4


@pytest.mark.parametrize("every", [1, 2, 5])
def test_updates_every_nth_step_with_the_time_since(walking, every):
    env, source, _ = walking
    maps = StepMap(env, source, CFG, every)
    start(env, maps)
    for step in range(11):
        env.common_step_counter = step
        maps.advance(env)
        assert source.reads == 1 + step // every
        assert clock(maps) == pytest.approx(3 * [step // every * every * env.step_dt])


def test_only_the_environments_that_begin_forget(walking):
    env, source, maps = walking
    start(env, maps)
    env.common_step_counter = 1
    before = known(maps)
    maps.reset(torch.tensor([0, 2]))
    assert known(maps).tolist() == [0, before[1], 0]
    source.base[0, 0] += 5.0  # the robot begins elsewhere
    maps.advance(env)
    assert (known(maps) == before).all() and maps.emap.center[0, 0] == pytest.approx(5.0, abs=0.1)


def test_no_time_has_passed_for_an_environment_that_began(walking):
    env, _, maps = walking
    start(env, maps)
    env.common_step_counter = 1
    maps.reset(torch.tensor([1]))
    maps.advance(env)
    assert clock(maps) == pytest.approx([0.02, 0.0, 0.02])


def test_a_reset_within_a_fused_step_leaves_the_other_maps_alone(walking):
    env, source, maps = walking
    start(env, maps)
    variance = maps.emap.layer("variance")
    source.height[2] = 2.2
    maps.reset(torch.tensor([2]))
    maps.advance(env)
    assert source.reads == 2
    torch.testing.assert_close(maps.emap.layer("variance")[:2], variance[:2], rtol=0, atol=0, equal_nan=True)
    elevation = maps.emap.layer("elevation")[2]
    assert (elevation[elevation.isfinite()] - 2.2).abs().max() < 1e-4
    maps.advance(env)
    assert source.reads == 2


def test_an_environment_that_begins_between_updates_waits_for_the_next(walking):
    env, source, _ = walking
    maps = StepMap(env, source, CFG, update_every=3)
    start(env, maps)
    env.common_step_counter = 1
    maps.reset(torch.tensor([1]))
    maps.advance(env)
    assert source.reads == 1 and known(maps)[1] == 0
    env.common_step_counter = 3
    maps.advance(env)
    assert source.reads == 2 and (known(maps) > 300).all()


@pytest.mark.parametrize("resumed", [0, 2, 120_000])
def test_goes_on_when_a_resumed_training_sets_the_counter(walking, resumed):
    env, source, maps = walking
    start(env, maps)
    env.common_step_counter = 5
    maps.advance(env)
    env.common_step_counter = resumed
    maps.advance(env)
    env.common_step_counter = resumed + 1
    maps.advance(env)
    assert source.reads == 4


@pytest.mark.parametrize(
    "ids, forgotten",
    [(None, [0, 1, 2]), (slice(None), [0, 1, 2]), (slice(1, 3), [1, 2]), ([0, 2], [0, 2]), (torch.tensor([1]), [1]),
     ([], []), (torch.tensor([True, False, True]), [0, 2]), ([False, True, False], [1]),
     (np.array([False, False, True]), [2])],
)  # fmt: skip
def test_takes_what_managers_pass_to_reset(walking, ids, forgotten):
    env, _, maps = walking
    start(env, maps)
    maps.reset(ids)
    assert [k for k in range(3) if known(maps)[k] == 0] == forgotten


def test_refuses_a_mask_of_another_size(walking):
    _, _, maps = walking
    with pytest.raises(ValueError, match=r"mask: expected \(3,\).*got \(2,\)"):
        maps.reset([True, False])


def test_works_in_inference_mode_and_outside_of_it(walking):
    env, source, _ = walking
    with torch.inference_mode():
        maps = StepMap(env, source, CFG)
        start(env, maps)
    maps.reset(torch.tensor([0]))
    env.common_step_counter = 1
    maps.advance(env)
    with torch.inference_mode():
        maps.reset(torch.tensor([1]))
        env.common_step_counter = 2
        maps.advance(env)
    maps.reset()
    assert (known(maps) == 0).all()


def test_terms_with_equal_settings_share_a_map():
    env, other = Env(), Env()
    source = GroundSource(torch.zeros(3, 3), torch.zeros(3))
    maps = share_map(env, source, CFG, 1)
    assert share_map(env, source, CFG, 1) is maps
    assert share_map(env, source, CFG, 2) is not maps
    assert share_map(env, GroundSource(torch.zeros(3, 3), torch.zeros(3)), CFG, 1) is not maps
    assert share_map(other, source, CFG, 1) is not maps


@pytest.mark.slow(1)
def test_maps_go_with_their_environment():
    env = Env()
    maps = weakref.ref(share_map(env, GroundSource(torch.zeros(3, 3), torch.zeros(3)), CFG, 1))
    assert maps() is not None
    del env
    gc.collect()
    assert maps() is None


def test_hits_become_points_of_the_sensor():
    origin = torch.tensor([[[1.0, 2.0, 3.0]], [[4.0, 5.0, 6.0]]])
    hits = torch.randn(2, 1, 7, 3)
    hits[0, 0, 3] = torch.inf
    cloud = to_cloud(hits, origin, missed=torch.arange(7).expand(2, 1, 7) == 5)
    homogeneous = torch.cat([cloud.points, torch.ones(2, 1, 7, 1)], -1)
    back = (cloud.T_map_sensor[:, :, None] @ homogeneous[..., None])[..., :3, 0]
    used = hits.isfinite().all(-1) & (torch.arange(7) != 5)
    torch.testing.assert_close(back[used], hits[used])
    assert not cloud.points[~used].isfinite().all(-1).any()


def test_joined_clouds_are_padded_with_nothing():
    clouds = [Cloud(torch.rand(2, 1, n, 3), torch.eye(4).repeat(2, 1, 1, 1) * n) for n in (2, 5)]
    points, poses = join(clouds)
    assert points.shape == (2, 2, 5, 3) and poses.shape == (2, 2, 4, 4)
    torch.testing.assert_close(points[:, 0, :2], clouds[0].points[:, 0])
    torch.testing.assert_close(points[:, 1], clouds[1].points[:, 0])
    assert points[:, 0, 2:].isnan().all() and (poses[:, 1, 0, 0] == 5).all()


@pytest.mark.parametrize("every", [0, -1, 1.5, "two"])
def test_refuses_another_cadence(walking, every):
    env, source, _ = walking
    with pytest.raises(ValueError, match="update_every: must be a positive int"):
        StepMap(env, source, CFG, every)
