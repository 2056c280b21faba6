"""MuJoCo's part: the height field, the states and the sensors."""

import dataclasses
from types import SimpleNamespace

import mujoco
import numpy as np
import pytest
import torch

from envs.quadruped import Quadruped
from envs.quadruped.config import GaitConfig, RandomConfig
from envs.quadruped.gait import foot_positions
from envs.quadruped.kinematics import joint_angles
from envs.quadruped.physics import ROBOT, Physics, build_model, lay_out
from tests.envs.quadruped.cases import FLAT_CFG, SMALL
from torchelev.sim import terrain_grid
from torchelev.sim.terrains.shapes import SHAPES

TERRAIN = terrain_grid(SMALL.kinds, 2, length=SMALL.length, resolution=0.05, seed=1)
SAME = RandomConfig(num_bodies=1, payload=(0, 0), center_of_mass=0.0, strength=(1, 1), friction=(1, 1))


def standing(physics, tiles):
    """Return positions (B, 19) of robots that stand in the middle of tiles."""
    still = foot_positions(torch.zeros(1), torch.zeros(1, 3), GaitConfig())
    qpos = torch.zeros(len(tiles), 19, dtype=torch.float64)
    qpos[:, :2], qpos[:, 2], qpos[:, 3] = physics.tile_origins[tiles], 0.32, 1.0
    qpos[:, 7:] = joint_angles(still)
    return qpos


@pytest.mark.parametrize("kind", SHAPES)
def test_eyes_see_the_ground_that_feet_stand_on(kind):
    terrain = dataclasses.replace(SMALL, kinds=(kind,), num_levels=4, difficulty=(0.0, 1.0), resolution=0.05)
    task = Quadruped(dataclasses.replace(FLAT_CFG, terrain=terrain), 1, perception="blind")
    field, (heights, origins) = task.terrain.field, lay_out(task.terrain)
    assert task.truth.field is field
    model = build_model(ROBOT, heights, 0.05)
    data = mujoco.MjData(model)
    data.qpos[2] = 50.0  # out of the rays' way
    mujoco.mj_forward(model, data)
    xy = (torch.rand(4, 50, 2, generator=torch.Generator().manual_seed(0)) - 0.5) * 5.0
    expected = field.height(torch.arange(4), xy).numpy()
    hit = np.zeros(1, np.int32)
    for tile in range(4):
        for place, z in zip((origins[tile] + xy[tile]).numpy(), expected[tile], strict=True):
            start = np.array([*place, 10.0])
            distance = mujoco.mj_ray(model, data, start, np.array([0, 0, -1.0]), None, 1, -1, hit, None)
            assert abs(10.0 - distance - z) < 0.001


def test_a_robot_stands_and_its_sensors_say_so():
    physics = Physics(TERRAIN, 2, SAME)
    qpos = standing(physics, [0, 2])
    physics.place([0, 1], qpos, torch.zeros(2, 18), torch.zeros(2, dtype=torch.int64))
    targets = qpos[:, 7:]
    for _ in range(50):
        physics.step(targets, torch.zeros(2, dtype=torch.int64), 4)
    sensed = physics.sensed()
    assert (sensed.foot_forces > 5).all() and (sensed.touches == 0).all()
    torch.testing.assert_close(
        sensed.foot_forces.sum(-1), torch.full((2,), 12 * 9.81, dtype=torch.float64), rtol=0.05, atol=0
    )
    assert sensed.sole_velocities.abs().max() < 0.01
    torch.testing.assert_close(physics.qpos[:, :2], physics.tile_origins[[0, 2]], atol=0.05, rtol=0)


def test_a_batch_moves_as_single_robots_do():
    both, alone = Physics(TERRAIN, 2, SAME, num_threads=2), Physics(TERRAIN, 1, SAME, num_threads=1)
    qpos = standing(both, [1, 3])
    both.place([0, 1], qpos, torch.zeros(2, 18), torch.zeros(2, dtype=torch.int64))
    alone.place([0], qpos[1:], torch.zeros(1, 18), torch.zeros(1, dtype=torch.int64))
    for k in range(10):
        targets = qpos[:, 7:] + 0.1 * np.sin(k)
        both.step(targets, torch.tensor([0, 1]), 4)
        alone.step(targets[1:], torch.tensor([1]), 4)
    torch.testing.assert_close(both.state[1:], alone.state, rtol=0, atol=1e-12)


def test_latency_delays_the_targets():
    early, late, never = (Physics(TERRAIN, 1, SAME, num_threads=1) for _ in range(3))
    qpos = standing(early, [0])
    for physics, latency in ((early, 0), (late, 3), (never, 4)):
        physics.place([0], qpos, torch.zeros(1, 18), torch.zeros(1, dtype=torch.int64))
        physics.step(qpos[:, 7:] + 0.2, torch.tensor([latency]), 4)
    moved = [float((p.qpos[:, 7:] - qpos[:, 7:]).abs().sum()) for p in (early, late, never)]
    assert moved[0] > moved[1] > moved[2]


@pytest.mark.parametrize("num_steps", [1, 4])
def test_the_sensors_belong_to_the_sensed_state(num_steps):
    physics = Physics(TERRAIN, 1, SAME, num_threads=1)
    qpos = standing(physics, [0])
    physics.place([0], qpos, torch.zeros(1, 18), torch.zeros(1, dtype=torch.int64))
    assert torch.equal(physics.sensed_state, physics.state)
    for _ in range(8):
        physics.step(qpos[:, 7:] + 0.2, torch.zeros(1, dtype=torch.int64), num_steps)
    model, velocities = physics.models[0], []
    data = mujoco.MjData(model)
    for state in (physics.sensed_state, physics.state):
        mujoco.mj_setState(model, data, state[0].numpy(), mujoco.mjtState.mjSTATE_FULLPHYSICS)
        mujoco.mj_forward(model, data)
        velocities.append(torch.from_numpy(data.sensordata[:12].copy()).view(4, 3))
    torch.testing.assert_close(physics.sensed().foot_velocities[0], velocities[0], rtol=0, atol=1e-9)
    assert (velocities[1] - velocities[0]).abs().max() > 1e-4, "the last state is another one"


@pytest.mark.parametrize("steps, num_steps", [(0, 1), (0, 4), (2, 4)])
def test_a_state_that_mujoco_resets_has_diverged(steps, num_steps, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)  # MuJoCo writes a log
    physics = Physics(TERRAIN, 3, SAME, num_threads=1)
    qpos, late = standing(physics, [0, 1, 2]), torch.zeros(3, dtype=torch.int64)
    physics.place([0, 1, 2], qpos, torch.zeros(3, 18), torch.zeros(3, dtype=torch.int64))
    for _ in range(steps):
        physics.step(qpos[:, 7:], late, num_steps)
        assert not physics.diverged.any()
    physics.qvel[0, 3], physics.qvel[2, 12] = torch.nan, 1e9
    physics.step(qpos[:, 7:], late, num_steps)
    assert physics.diverged.tolist() == [True, False, True] and physics.state.isfinite().all()
    physics.place([0, 2], qpos[[0, 2]], torch.zeros(2, 18), torch.zeros(2, dtype=torch.int64))
    assert not physics.diverged.any()


def test_bodies_differ_and_the_seed_repeats_them():
    a, b, c = (Physics(TERRAIN, 1, RandomConfig(), seed) for seed in (0, 0, 1))
    masses = [[model.body_mass.sum() for model in physics.models] for physics in (a, b, c)]
    assert masses[0] == masses[1] != masses[2] and len(set(masses[0])) == RandomConfig().num_bodies


def test_a_terrain_larger_than_the_height_field_is_refused():
    heights = torch.zeros(1).expand(4, 2050, 2050)  # the rims are shared
    terrain = dataclasses.replace(TERRAIN, field=SimpleNamespace(heights=heights, resolution=0.05))
    with pytest.raises(ValueError, match=r"field of 16777216 samples, got 16793604; take fewer"):
        Physics(terrain, 1, RandomConfig())


def test_a_model_without_the_joints_is_refused(tmp_path):
    path = tmp_path / "robot.xml"
    path.write_text(ROBOT.read_text().replace("FL_knee", "FL_ankle"))
    with pytest.raises(ValueError, match=r"robot: must have the 12 joints .*FL_ankle.*name them FL_abduction"):
        Physics(TERRAIN, 1, SAME, robot=path)
    path.write_text(ROBOT.read_text().replace('<touch name="FL_foot_force" site="FL_foot"/>', ""))
    with pytest.raises(ValueError, match="sensor values"):
        Physics(TERRAIN, 1, SAME, robot=path)


def test_the_robot_weighs_12_kg_and_has_12_joints():
    model = mujoco.MjModel.from_xml_path(str(ROBOT))
    assert abs(model.body_subtreemass[1] - 12.0) < 1e-9 and model.nu == 12
    assert dataclasses.asdict(RandomConfig())["num_bodies"] == 8
