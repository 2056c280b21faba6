"""TerrainNav for rsl-rl: its mirror symmetry."""

import dataclasses

import pytest
import torch
from tensordict import TensorDict

from envs.terrain_nav import TerrainNav, TerrainNavConfig
from envs.terrain_nav.robot import Ground
from envs.terrain_nav.rsl_rl import mirror
from tests.envs.terrain_nav_cases import ROBOT, SMALL
from torchelev.sim.terrains.heightfield import HeightField


@pytest.mark.slow(1)
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
