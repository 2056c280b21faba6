"""What an episode of TerrainNav brings, and what decides on it."""

import dataclasses

import pytest
import torch

import envs.terrain_nav.task as task_module
from envs.terrain_nav import SightConfig, TerrainNav, TerrainNavConfig
from envs.terrain_nav.course import RatedCourse, make_rated_course
from envs.terrain_nav.outcome import ENDINGS
from envs.terrain_nav.robot import Ground
from tests.envs.terrain_nav_cases import FLAT, ROBOT, SMALL, field_of, flat
from tests.helpers import NoGenerator
from torchelev.sim.sensors import mounted
from training.nav.evaluate import evaluate, straight_line


def test_walking_straight_on_flat_ground_succeeds_and_the_reward_is_its_formula():
    cfg = TerrainNavConfig(course=FLAT)
    task = TerrainNav(cfg, 3, perception="blind", seed=1)
    weight, last = cfg.reward, torch.zeros(3, 2)
    for _ in range(cfg.max_episode_length):
        before, action = task.distance.clone(), straight_line(task.observe())
        outcome = task.advance(action)
        for k in range(3):
            d = float(torch.linalg.vector_norm(task.goal[k] - task.xy[k]))
            change = sum(float(action[k, a] - last[k, a]) ** 2 for a in range(2))
            expected = weight.progress * (float(before[k]) - d) + weight.time + weight.action_rate * change
            expected += weight.success * (d < 0.4)
            assert float(outcome.reward[k]) == pytest.approx(expected, abs=1e-4)
        last = action
        if bool(outcome.success.all()):
            return
    raise AssertionError("the goal was not reached")


def placed(course_height, **settings):
    """Return a task of one robot at the origin, heading for a goal 3 m ahead, on ground of this height."""
    task = TerrainNav(TerrainNavConfig(course=FLAT, **settings), 1, perception="blind")
    task.course = dataclasses.replace(task.course, field=field_of(course_height))
    task.ground = Ground(task.course.field, task.cfg.robot.reach)
    for name, value in {"xy": (0.0, 0.0), "goal": (3.0, 0.0)}.items():
        getattr(task, name).copy_(torch.tensor([value]))
    task.yaw.zero_()
    return task


def run(task, steps, action=(1.0, 0.0)):
    for step in range(steps):
        outcome = task.advance(torch.tensor([action]))
        if bool(outcome.done):
            return step + 1, outcome
    return steps, outcome


@pytest.mark.slow(1)
def test_a_straight_line_fails_more_often_than_not():
    cfg = TerrainNavConfig(course=SMALL)
    result = evaluate(straight_line, cfg, "truth", episodes=256)
    assert result["success"] < 0.5
    assert sum(result[name] for name in ENDINGS) == 1.0, "each robot counts once, by its first episode"


def test_walls_end_in_being_stuck():
    steps, outcome = run(placed(lambda x, y: 0.5 * (x > 1.0)), 100)
    assert bool(outcome.stuck) and bool(outcome.terminated) and not bool(outcome.success | outcome.fallen)
    assert float(outcome.reward) == pytest.approx(-5.0 - 0.1 - 0.02, abs=0.05)
    assert steps > 15  # 3 s of being blocked, and the way there


def test_pits_end_in_a_fall():
    _, outcome = run(placed(lambda x, y: -0.8 * (x > 1.0)), 100)
    assert bool(outcome.fallen) and bool(outcome.terminated) and not bool(outcome.stuck)
    assert float(outcome.reward) < -4.5


@pytest.mark.slow(1)
def test_time_runs_out():
    steps, outcome = run(placed(flat), 1000, action=(0.0, 0.0))
    assert steps == 100 and bool(outcome.truncated) and not bool(outcome.terminated)


@pytest.mark.slow(1)
def test_reset_of_some_leaves_the_others_alone():
    task = TerrainNav(TerrainNavConfig(course=SMALL), 4, perception="map")
    for _ in range(3):
        task.advance(torch.ones(4, 2))
        task.sense()
    before = {name: value.clone() for name, value in task.state_dict().items() if isinstance(value, torch.Tensor)}
    mask = torch.tensor([True, False, False, True])
    task.reset(mask)
    for name, value in task.state_dict().items():
        if isinstance(value, torch.Tensor) and value.ndim and len(value) == 4:
            assert torch.equal(value[1:3], before[name][1:3]), name
    assert task.episode_length.tolist() == [0, 3, 3, 0]
    known = task.sight.emap.layer("validity").flatten(1).sum(1)
    assert known[0] == 0 and known[3] == 0 and known[1] > 100


def test_wrong_arguments_are_refused():
    with pytest.raises(ValueError, match="perception: must be one of map, truth, blind"):
        TerrainNav(perception="lidar")
    task = TerrainNav(TerrainNavConfig(course=FLAT), 2, perception="blind")
    xy = task.xy.clone()
    with pytest.raises(ValueError, match=r"action: expected \(2, 2\), got \(3, 2\)"):
        task.advance(torch.ones(3, 2))
    assert torch.equal(task.xy, xy) and int(task.episode_length.sum()) == 0
    with pytest.raises(ValueError, match="dt: must be positive"):
        TerrainNavConfig(dt=0.0)
    with pytest.raises(ValueError, match="sight.window: must hold the crop at any heading"):
        SightConfig(crop_length=5.0)
    with pytest.raises(ValueError, match="sight.fill: must be one of ground, base, .*inpaint, got 'zero'; use base"):
        SightConfig(fill="zero")


def test_actions_that_are_no_numbers_count_as_zero():
    task = TerrainNav(TerrainNavConfig(course=FLAT), 2, perception="blind")
    xy = task.xy.clone()
    assert bool(task.advance(torch.full((2, 2), torch.nan)).reward.isfinite().all())
    assert torch.equal(task.xy, xy)


def rollout(task, steps):
    seen = []
    for k in range(steps):
        outcome = task.advance(torch.full((task.num_envs, 2), 0.9 - 0.2 * (k % 3)))
        task.reset(outcome.done)
        task.sense()
        seen.append(task.observe())
    return seen


@pytest.mark.slow(1)
@pytest.mark.parametrize("perception", ["map", "truth"])
def test_a_restored_state_goes_on_as_if_never_stopped(perception):
    cfg = TerrainNavConfig(course=SMALL, episode_length=1.0)  # so that episodes end meanwhile
    one = TerrainNav(cfg, 3, perception=perception, seed=1)
    rollout(one, 7)
    other = TerrainNav(cfg, 3, perception=perception, seed=2)
    other.load_state_dict(one.state_dict())
    for a, b in zip(rollout(one, 8), rollout(other, 8), strict=True):
        for name in a:
            assert torch.equal(a[name], b[name]), name


@pytest.mark.slow(1)
def test_seeds_make_episodes():
    cfg = TerrainNavConfig(course=SMALL)
    seen = []
    for seed in (1, 1, 2):
        task = TerrainNav(cfg, 3)
        task.seed(seed)
        task.reset()
        task.sense()
        seen.append(rollout(task, 3)[-1])
    assert torch.equal(seen[0]["map"], seen[1]["map"]) and torch.equal(seen[0]["policy"], seen[1]["policy"])
    assert not torch.equal(seen[0]["policy"], seen[2]["policy"])


@pytest.mark.slow(2)
@pytest.mark.parametrize("perception", ["map", "truth", "blind"])
def test_host_reads_nothing_back_from_the_device(monkeypatch, perception):
    # Tensors on "meta" have no values, so that reading one raises; copying one from the host needs a constructor.
    course = make_rated_course(SMALL)
    ground = Ground(course.field, ROBOT.reach)
    ground.field, ground.highest = ground.field.to("meta"), ground.highest.to("meta")
    parts = (course.field, course.starts, course.goals, course.traversability)
    moved = RatedCourse(*(part.to("meta") for part in parts))
    monkeypatch.setattr(task_module, "make_rated_course", lambda cfg, device: moved)
    monkeypatch.setattr(task_module, "Ground", lambda *_: ground)
    monkeypatch.setattr(torch, "Generator", NoGenerator)
    monkeypatch.setattr(mounted, "check_pose", lambda *_: None)  # reads the cameras' mountings when they are built
    rand = torch.rand
    monkeypatch.setattr(torch, "rand", lambda *shape, generator, device: rand(*shape, device=device))
    task = TerrainNav(TerrainNavConfig(course=SMALL), 3, "meta", perception)
    for number in range(3):
        if number:  # the first step copies patterns to the device
            for name in ("tensor", "as_tensor", "from_numpy"):
                monkeypatch.setattr(torch, name, None)
        task.reset(task.advance(torch.empty(3, 2, device="meta")).done)
        task.sense()
        assert all(part.is_meta for part in [*task.observe().values(), *task.ending_fractions.values()])
