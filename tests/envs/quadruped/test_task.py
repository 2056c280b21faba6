"""The quadruped task: steps, endings, curriculum, seeds."""

import dataclasses

import pytest
import torch

from envs.quadruped import Quadruped
from envs.quadruped.config import RandomConfig
from envs.quadruped.kinematics import feet_in_base
from envs.quadruped.proprioception import rotation_matrix
from tests.envs.quadruped.cases import CFG, FLAT_CFG

CALM = RandomConfig(push=0.0, max_latency=0)


def run(task, steps, action=None):
    outcomes = []
    for _ in range(steps):
        outcomes.append(task.advance(torch.zeros(task.num_envs, 12) if action is None else action))
        task.sense()
    return outcomes


@pytest.mark.slow(1)
def test_the_trot_walks_without_learning():
    cfg = dataclasses.replace(FLAT_CFG, random=CALM)
    task = Quadruped(cfg, 4, perception="blind")
    task.command[:, 0] = 0.5
    outcomes = run(task, 150)
    assert not torch.stack([o.fallen for o in outcomes]).any()
    assert (torch.linalg.vector_norm(task.T_map_base[:, :2, 3], dim=-1) > 0.2).all()


def test_a_robot_upside_down_has_fallen():
    task = Quadruped(CFG, 2, perception="blind")
    task.physics.state[1, 4:8] = torch.tensor([0.0, 1.0, 0.0, 0.0])
    outcome = run(task, 1)[0]
    assert outcome.fallen.tolist() == [False, True] and outcome.terminated.tolist() == [False, True]
    assert float(outcome.reward[1]) < float(outcome.reward[0]) - 2


def test_a_robot_at_the_rim_has_crossed_and_moves_up():
    task = Quadruped(CFG, 4, perception="blind")
    task.place_at(torch.zeros(4, dtype=torch.int64))
    task.physics.state[0, 1] += 2.8
    outcome = run(task, 1)[0]
    assert outcome.crossed.tolist() == [True, False, False, False] and outcome.truncated[0]
    task.reset(outcome.done)
    assert task.level.tolist() == [1, 0, 0, 0]
    assert float(task.T_map_base[0, :2, 3].abs().max()) < 0.5, "begins in the middle of its new tile"


@pytest.mark.parametrize("joint_speed", [torch.nan, 1e9])
@pytest.mark.parametrize("steps", [0, 3])
def test_a_diverged_robot_has_fallen_and_stays_at_its_level(joint_speed, steps, tmp_path, monkeypatch):
    """MuJoCo puts it back to the model's first pose, which is beyond the rim of its tile."""
    monkeypatch.chdir(tmp_path)  # MuJoCo writes a log
    task = Quadruped(CFG, 4, perception="blind")
    task.place_at(torch.zeros(4, dtype=torch.int64))
    run(task, steps)
    task.physics.qvel[0, 10] = joint_speed
    outcome = run(task, 1)[0]
    assert outcome.fallen.tolist() == [True, False, False, False] and not outcome.crossed.any()
    assert outcome.reward.isfinite().all() and float(outcome.reward[0]) < -1
    task.reset(outcome.done)
    assert task.level.tolist() == [0, 0, 0, 0]
    assert not run(task, 1)[0].fallen.any()


def test_a_robot_that_falls_at_the_rim_stays_at_its_level():
    task = Quadruped(CFG, 4, perception="blind")
    task.place_at(torch.zeros(4, dtype=torch.int64))
    task.physics.state[0, 1] += 2.8
    task.physics.state[0, 4:8] = torch.tensor([0.0, 1.0, 0.0, 0.0])
    outcome = run(task, 1)[0]
    assert outcome.fallen[0] and not outcome.crossed[0]
    task.reset(outcome.done)
    assert task.level.tolist() == [0, 0, 0, 0]


def test_a_robot_that_has_not_come_half_as_far_as_commanded_moves_down():
    task = Quadruped(CFG, 2, perception="blind")
    task.place_at(torch.ones(2, dtype=torch.int64))
    task.commanded.copy_(torch.tensor([5.0, 0.0]))
    task.reset(torch.ones(2, dtype=torch.bool))
    assert task.level.tolist() == [0, 1]


def test_time_runs_out():
    task = Quadruped(dataclasses.replace(CFG, episode_length=0.1), 1, perception="blind")
    outcomes = run(task, 5)
    assert [bool(o.timed_out) for o in outcomes] == [False] * 4 + [True] and not outcomes[-1].terminated


@pytest.mark.slow(1)
@pytest.mark.parametrize("perception", ["map", "truth"])
def test_the_seed_repeats_an_episode(perception):
    seen = []
    for seed in (5, 5, 6):
        task = Quadruped(CFG, 3, perception=perception, seed=0)
        task.seed(seed)
        task.reset()
        task.sense()
        run(task, 6, torch.full((3, 12), 0.3))
        seen.append(task.observe())
    assert all(torch.equal(seen[0][name], seen[1][name]) for name in seen[0])
    assert not torch.equal(seen[0]["policy"], seen[2]["policy"])


def test_reset_changes_the_chosen_environments_only():
    task = Quadruped(CFG, 3, perception="map")
    run(task, 6)
    state, validity = task.physics.state.clone(), task.sight.emap.layer("validity")
    task.reset(torch.tensor([False, True, False]))
    assert torch.equal(task.physics.state[[0, 2]], state[[0, 2]])
    after = task.sight.emap.layer("validity")
    assert torch.equal(after[[0, 2]], validity[[0, 2]]) and not after[1].any()


def test_the_map_is_updated_at_every_fourth_step():
    task = Quadruped(CFG, 1, perception="map")
    counts = []
    update = task.sight.emap.update
    task.sight.emap.update = lambda *args, **links: (counts.append(float(args[3])), update(*args, **links))
    run(task, 9)
    assert len(counts) == 2 and counts == pytest.approx([0.08, 0.08]), "the first one came with the reset"


def test_steps_run_in_inference_mode_and_after_it():
    task = Quadruped(CFG, 2, perception="map")
    with torch.inference_mode():
        run(task, 5)
        task.reset(torch.tensor([True, False]))
    run(task, 5)
    task.reset()


@pytest.mark.slow(1)
@pytest.mark.parametrize("perception", ["map", "truth"])
def test_the_state_dict_continues_an_episode(perception):
    a, b = (Quadruped(CFG, 2, perception=perception, seed=0) for _ in range(2))
    run(a, 5)
    a.observe()  # the truth draws its noise
    b.load_state_dict(a.state_dict())
    for x, y in zip(run(a, 5), run(b, 5), strict=True):
        assert torch.equal(x.reward, y.reward)
    expected, actual = a.observe(), b.observe()
    assert [name for name in expected if not torch.equal(expected[name], actual[name])] == []
    for task in (a, b):
        task.reset()
        task.sense()
    expected, actual = a.observe(), b.observe()
    assert [name for name in expected if not torch.equal(expected[name], actual[name])] == [], "the next episode"


def test_bad_input_is_refused():
    with pytest.raises(ValueError, match="perception: must be one of map, truth, blind"):
        Quadruped(CFG, 1, perception="sonar")
    task = Quadruped(CFG, 2, perception="blind")
    state = task.physics.state.clone()
    with pytest.raises(ValueError, match=r"action: expected \(2, 12\), got \(2, 11\)"):
        task.advance(torch.zeros(2, 11))
    assert torch.equal(task.physics.state, state)
    with pytest.raises(ValueError, match="substeps"):
        dataclasses.replace(CFG, substeps=0)


def test_an_action_of_nan_counts_as_zero():
    a, b = (Quadruped(CFG, 1, perception="blind", seed=0) for _ in range(2))
    x, y = a.advance(torch.full((1, 12), torch.nan)), b.advance(torch.zeros(1, 12))
    assert torch.equal(x.reward, y.reward)


def test_pushes_change_the_velocity():
    """Compared with twins that nothing pushes."""
    velocities = []
    for push in (0.5, 0.0):
        random = dataclasses.replace(CALM, push=push, push_interval=0.02)
        task = Quadruped(dataclasses.replace(FLAT_CFG, random=random), 16, perception="blind", seed=0)
        task.advance(torch.zeros(16, 12))
        velocities.append(task.physics.qvel.clone())
    change = (velocities[0] - velocities[1]).abs()
    assert not change[:, 2:].any() and (change[:, :2] <= 0.5).all()
    assert ((change[:, :2] > 0.01).any(-1)).float().mean() > 0.8 and change.max() > 0.25


def test_odometry_gets_velocities_of_one_instant():
    """MuJoCo's sensors are those of the instant before its last step."""
    task, given = Quadruped(CFG, 2, perception="blind", seed=2), []
    task.odometry.step = lambda *args: given.append([value.clone() for value in args[:3]])
    run(task, 7)
    velocity, soles, forces = given[-1]
    rotation = rotation_matrix(task.physics.sensed_state[:, 4:8]).float()
    feet = foot_velocities(task.physics.sensed_state) + velocity[:, None] @ rotation
    sensed = task.physics.sensed()
    torch.testing.assert_close(feet @ rotation.mT, sensed.foot_velocities.float(), atol=1e-3, rtol=0)
    torch.testing.assert_close((soles, forces), (sensed.sole_velocities.float(), sensed.foot_forces.float()))


def test_the_critic_gets_foot_velocities_in_the_base_frame():
    task = Quadruped(CFG, 8, perception="blind", seed=2)
    run(task, 7)
    state = task.physics.sensed_state
    base = state[:, None, 20:23] @ rotation_matrix(state[:, 4:8])
    feet = task.observe()["privileged"][:, 7:19].unflatten(-1, (4, 3))
    torch.testing.assert_close(feet, foot_velocities(state) + base.float(), atol=1e-3, rtol=0)


def foot_velocities(state):
    """Return the velocities (B, 4, 3) of the feet relative to the base's in the base frame, by the kinematics."""
    joints, turn, rates = state[:, 8:20].float(), state[:, 23:26].float(), state[:, 26:38].float()
    feet, moved = torch.func.jvp(feet_in_base, (joints,), (rates,))
    return moved + torch.linalg.cross(turn[:, None].expand_as(feet), feet)
