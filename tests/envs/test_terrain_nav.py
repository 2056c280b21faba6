"""TerrainNav: how robots move, what an episode brings, what is seen."""

import dataclasses
import math

import numpy as np
import pytest
import torch
from tensordict import TensorDict

import envs.terrain_nav.task as task_module
from envs.terrain_nav import BodyConfig, CourseConfig, SightConfig, TerrainNav, TerrainNavConfig
from envs.terrain_nav.course import Course, make_course
from envs.terrain_nav.robot import Ground, RobotState, advance, base_pose
from envs.terrain_nav.rsl_rl import mirror
from envs.terrain_nav.task import ENDINGS
from tests.helpers import NoGenerator
from torchelev.sim.sensors import mounted
from torchelev.sim.terrains.heightfield import HeightField
from training.nav.evaluate import evaluate, straight_line

ROBOT = BodyConfig()
SMALL = CourseConfig(num_tiles=4, num_routes=16)
FLAT = CourseConfig(num_tiles=1, num_routes=8, shares=(0.0, 0.0, 0.0), roughness=0.0)
IDS = torch.zeros(1, dtype=torch.int64)


def field_of(height, resolution=0.05, length=8.0):
    """Sample height(x, y), of NumPy arrays, as one tile."""
    count = round(length / resolution) + 1
    axis = (np.arange(count) - (count - 1) / 2) * resolution
    x, y = np.meshgrid(axis, axis, indexing="ij")
    return HeightField(torch.tensor(height(x, y), dtype=torch.float32)[None], resolution)


def standing(x=0.0, y=0.0, yaw=0.0):
    no = torch.zeros(1, dtype=torch.bool)
    return RobotState(torch.tensor([[x, y]]), torch.tensor([yaw]), torch.zeros(1, 2), no, no)


def drive(field, action, seconds, state=None):
    """Drive one robot; return its states at 20 Hz."""
    ground, states = Ground(field, ROBOT.reach), [state or standing()]
    for _ in range(round(seconds / 0.05)):
        states.append(advance(states[-1], torch.tensor([action]), IDS, ground, ROBOT, 0.05))
    return states


def flat(x, y):
    return 0 * x


def test_velocity_approaches_the_command():
    states = drive(field_of(flat), (1.0, 0.0), 1.0)
    v, x = 0.0, 0.0
    for state in states[1:]:
        v += (1.0 - v) * 0.25  # dt / response
        x += v * 0.05
        assert float(state.velocity[0, 0]) == pytest.approx(v, abs=1e-5)
        assert float(state.xy[0, 0]) == pytest.approx(x, abs=1e-5)


def test_backward_is_slower_and_turning_turns_left():
    back = drive(field_of(flat), (-1.0, 0.0), 3.0)[-1]
    assert float(back.velocity[0, 0]) == pytest.approx(-1 / 3, abs=1e-3)
    turned = drive(field_of(flat), (0.0, 1.0), 3.0)[-1]
    assert float(turned.velocity[0, 1]) == pytest.approx(1.5, abs=1e-3)
    assert float(turned.yaw[0]) > 3.5 and turned.xy.abs().max() < 1e-6


@pytest.mark.parametrize("rise, passes", [(0.1, True), (0.15, True), (0.3, False), (0.7, False)])
def test_low_steps_are_climbed_and_high_ones_block(rise, passes):
    last = drive(field_of(lambda x, y: rise * (x > 1.0)), (1.0, 0.0), 6.0)[-1]
    assert bool(last.blocked[0]) != passes and not bool(last.fallen[0])
    if passes:
        assert float(last.xy[0, 0]) > 2.0
    else:  # the footprint stops before the step, less than its reach and a substep away
        assert 0.6 - 0.1 < float(last.xy[0, 0]) + 0.3 + 0.1 - 0.3 <= 0.75


@pytest.mark.parametrize("drop, falls", [(0.15, False), (0.25, False), (0.5, True), (1.0, True)])
def test_deep_drops_are_falls(drop, falls):
    states = drive(field_of(lambda x, y: -drop * (x > 1.0)), (1.0, 0.0), 4.0)
    assert bool(states[-1].fallen[0]) == falls
    if falls:  # it stays where it fell, at the edge
        assert 0.5 < float(states[-1].xy[0, 0]) < 0.8
        assert states[-1].velocity.abs().max() == 0


def test_slopes_slow_down():
    gentle, steep = (drive(field_of(lambda x, y, g=g: g * x), (1.0, 0.0), 2.0)[-1].xy[0, 0] for g in (0.1, 0.4))
    assert float(steep) < 0.7 * float(gentle)


def test_base_pose_on_a_slope():
    field = field_of(lambda x, y: 0.2 * x + 0.1 * y)
    T = base_pose(torch.tensor([[0.5, -0.3]]), torch.tensor([0.7]), IDS, field, ROBOT)[0].double()
    normal = torch.tensor([-0.2, -0.1, 1.0], dtype=torch.float64)
    assert torch.allclose(T[:3, 2], normal / normal.norm(), atol=1e-4)
    assert torch.allclose(T[:3, :3] @ T[:3, :3].T, torch.eye(3, dtype=torch.float64), atol=1e-5)
    assert math.atan2(T[1, 0], T[0, 0]) == pytest.approx(0.7, abs=1e-5)
    assert float(T[2, 3]) == pytest.approx(0.2 * 0.5 - 0.1 * 0.3 + 0.45, abs=1e-4)


# The course ---------------------------------------------------------------------------------------------------------


def test_courses_come_from_their_seed():
    one, same, other = (make_course(dataclasses.replace(SMALL, seed=seed)) for seed in (3, 3, 4))
    assert torch.equal(one.field.heights, same.field.heights) and torch.equal(one.starts, same.starts)
    assert not torch.equal(one.field.heights, other.field.heights)


def test_routes_are_of_the_wanted_length_between_level_places():
    course = make_course(SMALL)
    distance = (course.starts - course.goals).norm(dim=-1)
    assert float(distance.min()) >= 4.0 and float(distance.max()) <= 6.0
    ring = torch.stack([torch.tensor([math.cos(a), math.sin(a)]) for a in torch.linspace(0, 6.28, 16).tolist()]) * 0.4
    for places in (course.starts, course.goals):
        around = (places[:, :, None] + ring).flatten(1, 2)
        heights = course.field.height(torch.arange(4), around).view(4, -1, 16)
        assert float((heights.amax(-1) - heights.amin(-1)).max()) < 0.2


def test_a_straight_line_fails_more_often_than_not():
    cfg = TerrainNavConfig(course=SMALL)
    result = evaluate(straight_line, cfg, "truth", episodes=256)
    assert result["success"] < 0.5
    assert sum(result[name] for name in ENDINGS) == 1.0, "each robot counts once, by its first episode"


def test_obstacles_leave_gaps_and_bad_settings_are_refused():
    with pytest.raises(ValueError, match="course.spacing: must leave a gap"):
        CourseConfig(spacing=1.0)
    with pytest.raises(ValueError, match="course.shares"):
        CourseConfig(shares=(0.5, 0.5, 0.5))


# Episodes -----------------------------------------------------------------------------------------------------------


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
        task._put(name, torch.tensor([value]))
    task._put("yaw", torch.zeros(1))
    return task


def run(task, steps, action=(1.0, 0.0)):
    for step in range(steps):
        outcome = task.advance(torch.tensor([action]))
        if bool(outcome.done):
            return step + 1, outcome
    return steps, outcome


def test_walls_end_in_being_stuck():
    steps, outcome = run(placed(lambda x, y: 0.5 * (x > 1.0)), 100)
    assert bool(outcome.stuck) and bool(outcome.terminated) and not bool(outcome.success | outcome.fallen)
    assert float(outcome.reward) == pytest.approx(-5.0 - 0.1 - 0.02, abs=0.05)
    assert steps > 15  # 3 s of being blocked, and the way there


def test_pits_end_in_a_fall():
    _, outcome = run(placed(lambda x, y: -0.8 * (x > 1.0)), 100)
    assert bool(outcome.fallen) and bool(outcome.terminated) and not bool(outcome.stuck)
    assert float(outcome.reward) < -4.5


def test_time_runs_out():
    steps, outcome = run(placed(flat), 1000, action=(0.0, 0.0))
    assert steps == 100 and bool(outcome.truncated) and not bool(outcome.terminated)


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


def test_actions_that_are_no_numbers_count_as_zero():
    task = TerrainNav(TerrainNavConfig(course=FLAT), 2, perception="blind")
    xy = task.xy.clone()
    assert bool(task.advance(torch.full((2, 2), torch.nan)).reward.isfinite().all())
    assert torch.equal(task.xy, xy)


# Sight --------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("perception", ["map", "truth", "blind"])
def test_observations_have_the_same_shapes_are_fresh_and_finite(perception):
    task = TerrainNav(TerrainNavConfig(course=SMALL), 3, perception=perception)
    first = task.observe()
    kept = {name: value.clone() for name, value in first.items()}
    shapes = {name: tuple(value.shape) for name, value in first.items()}
    image = (3, 4, 16, 16)
    assert shapes == {"policy": (3, 12), "map": image, "truth": image}
    for _ in range(4):
        task.advance(torch.ones(3, 2))
        task.sense()
        assert all(bool(value.isfinite().all()) for value in task.observe().values())
    for name, value in first.items():
        assert torch.equal(value, kept[name]), f"{name} changed after it was returned"


def test_truth_is_the_ground_at_the_crops_pixels():
    task = TerrainNav(TerrainNavConfig(course=SMALL), 2, perception="truth", seed=5)
    image = task.observe()["truth"]
    field, T = task.course.field, task.T_map_base
    for env in range(2):
        for i, j in [(0, 0), (3, 12), (15, 15), (8, 2)]:
            ahead, left = 0.8 + (i + 0.5 - 8) * 0.2, (j + 0.5 - 8) * 0.2
            yaw = float(task.yaw[env])
            x = float(task.xy[env, 0]) + math.cos(yaw) * ahead - math.sin(yaw) * left
            y = float(task.xy[env, 1]) + math.sin(yaw) * ahead + math.cos(yaw) * left
            ground = float(field.height(task.tile_ids[env : env + 1], torch.tensor([[[x, y]]])))
            expected = ground - (float(T[env, 2, 3]) - 0.45)
            assert float(image[env, 0, i, j]) == pytest.approx(expected, abs=2e-3)
    assert torch.equal(image[:, 0], image[:, 1]) and bool((image[:, 2] == 1).all())


def test_white_noise_is_uniform_and_new_at_each_look():
    task = TerrainNav(TerrainNavConfig(course=SMALL), 64, perception="truth")
    seen = task.observe()
    error = seen["map"][:, 0] - seen["truth"][:, 0]
    assert 0.099 < float(error.abs().max()) <= 0.1 + 1e-6
    assert float(error.std()) == pytest.approx(0.1 / 3**0.5, rel=0.05)
    assert torch.equal(task.observe()["map"], seen["map"])
    task.sense()
    assert not torch.equal(task.observe()["map"], seen["map"])


def test_blind_sees_nothing():
    task = TerrainNav(TerrainNavConfig(course=SMALL), 2, perception="blind")
    assert float(task.observe()["map"].abs().max()) == 0.0


def test_the_map_shows_the_ground_where_errors_are_none():
    sight = SightConfig(sensor_errors="perfect", pose_errors="perfect")
    task = TerrainNav(TerrainNavConfig(course=dataclasses.replace(FLAT, roughness=0.05), sight=sight), 8)
    for _ in range(5):
        task.advance(torch.tensor([[0.5, 0.3]]).expand(8, 2))
        task.sense()
    seen = task.observe()
    known = seen["map"][:, 2] > 0
    assert float(known.float().mean()) > 0.3
    error = (seen["map"][:, 0] - seen["truth"][:, 0])[known].abs()
    assert float(error.median()) < 0.01 and float(error.quantile(0.99)) < 0.05


def test_rays_start_where_cameras_are_and_points_go_where_odometry_says(monkeypatch):
    task = TerrainNav(TerrainNavConfig(course=SMALL, sight=SightConfig(sensor_errors="perfect")), 3)
    for _ in range(5):
        task.advance(torch.ones(3, 2))
        task.sense()
    sight, T = task.sight, task.T_map_base
    assert float((sight.T_estimated - T).abs().max()) > 1e-3
    bent = torch.eye(4).repeat(3, 1, 1)
    bent[:, :3, 3] = torch.tensor([0.1, -0.05, 0.02])
    for errors in sight.sensor_errors:
        monkeypatch.setattr(errors, "mounting", lambda: bent)
    points, poses = sight.look(T, task.tile_ids)
    for k, camera in enumerate(sight.cameras):
        seen = camera(task.course.field, task.tile_ids, T, T_base_sensor=camera.T_base_sensor @ bent)
        torch.testing.assert_close(points[:, k], seen, equal_nan=True)
        torch.testing.assert_close(poses[:, k], sight.T_estimated @ camera.T_base_sensor)


def test_each_look_casts_from_the_true_pose(monkeypatch):
    task = TerrainNav(TerrainNavConfig(course=SMALL), 3)
    asked, look = [], task.sight.look
    monkeypatch.setattr(task.sight, "look", lambda T, tile_ids: asked.append(T) or look(T, tile_ids))
    task.advance(torch.ones(3, 2))
    task.sense()
    torch.testing.assert_close(asked[0], task.T_map_base)


def test_the_map_is_placed_by_odometry_that_drifts():
    task = TerrainNav(TerrainNavConfig(course=FLAT), 8)
    errors = []
    for _ in range(20):
        task.advance(torch.tensor([[1.0, 0.2]]).expand(8, 2))
        task.sense()
        errors.append((task.sight.T_estimated - task.T_map_base)[:, :2, 3].norm(dim=-1))
    assert float(errors[-1].min()) > 1e-3 and float(errors[-1].mean()) > 2 * float(errors[0].mean())
    expected = torch.linalg.vector_norm(task.goal - task.xy, dim=-1) / 5  # where the goal is does not drift
    torch.testing.assert_close(task.observe()["policy"][:, 2], expected)


# Random numbers and state -------------------------------------------------------------------------------------------


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
    course = make_course(SMALL)
    ground = Ground(course.field, ROBOT.reach)
    ground.field, ground.highest = ground.field.to("meta"), ground.highest.to("meta")
    moved = [course.field, course.traversability, course.starts, course.goals]
    monkeypatch.setattr(task_module, "make_course", lambda cfg, device: Course(*(part.to(device) for part in moved)))
    monkeypatch.setattr(task_module, "Ground", lambda field, reach: ground)
    monkeypatch.setattr(torch, "Generator", NoGenerator)
    monkeypatch.setattr(mounted, "check_pose", lambda *_: None)  # reads the cameras' mountings when they are built
    monkeypatch.setattr(TerrainNav, "seed", lambda *_: None)
    rand = torch.rand
    monkeypatch.setattr(torch, "rand", lambda *shape, generator, device: rand(*shape, device=device))
    task = TerrainNav(TerrainNavConfig(course=SMALL), 3, "meta", perception)
    for number in range(3):
        if number:  # the first step copies patterns to the device
            for name in ("tensor", "as_tensor", "from_numpy"):
                monkeypatch.setattr(torch, name, None)
        task.reset(task.advance(torch.empty(3, 2, device="meta")).done)
        task.sense()
        assert all(part.is_meta for part in [*task.observe().values(), *task.shares.values()])


def test_a_mirror_exchanges_left_and_right():
    task, mirrored = (TerrainNav(TerrainNavConfig(course=SMALL), 16, perception="truth", seed=3) for _ in range(2))
    for field in ("field", "traversability"):
        flipped = HeightField(getattr(task.course, field).heights.flip(2), SMALL.resolution)
        mirrored.course = dataclasses.replace(mirrored.course, **{field: flipped})
    mirrored.ground = Ground(mirrored.course.field, ROBOT.reach)
    mirrored.truth.course = mirrored.sight.course = mirrored.course
    for name in ("xy", "goal"):
        getattr(mirrored, name).mul_(torch.tensor([1.0, -1.0]))
    mirrored.yaw.neg_()
    mirrored.sight.noise.zero_(), task.sight.noise.zero_()
    generator = torch.Generator().manual_seed(0)
    for _ in range(10):
        seen = {name: TensorDict(each.observe(), batch_size=[16]) for name, each in (("", task), ("mirror", mirrored))}
        doubled, _ = mirror(None, seen[""])
        assert doubled.batch_size == (32,)
        for name, expected in seen["mirror"].items():
            assert torch.equal(doubled[name][:16], seen[""][name])
            torch.testing.assert_close(doubled[name][16:], expected, atol=1e-4, rtol=1e-4)
        action = 2 * torch.rand(16, 2, generator=generator) - 1
        _, actions = mirror(None, None, action)
        assert torch.equal(actions[:16], action)
        outcomes = task.advance(action), mirrored.advance(actions[16:])
        torch.testing.assert_close(*outcomes, atol=1e-4, rtol=1e-4)
