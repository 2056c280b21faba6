"""The reward, term by term, against its formulas in loops."""

import math

import pytest
import torch

from envs.quadruped.config import RewardConfig
from envs.quadruped.episode.rewards import Motion, reward, terms


def motion(seed=0, count=3):
    g = torch.Generator().manual_seed(seed)
    sizes = dict(velocity=3, angular_velocity=3, gravity=3, command=3, torques=12, joint_acceleration=12, action=12,
                 last_action=12, touches=13, foot_speed=4)  # fmt: skip
    values = {name: torch.randn(count, n, generator=g) for name, n in sizes.items()}
    values["touches"] = (values["touches"] > 0).float()
    stands = torch.rand(count, 4, generator=g) > 0.5
    return Motion(**values, stands=stands, fallen=torch.tensor([True, False, False]))


def square(values):
    return sum(float(v) ** 2 for v in values)


def by_hand(m, k, sigma):
    v, w, c = m.velocity[k], m.angular_velocity[k], m.command[k]
    return {
        "linear_velocity": math.exp(-((c[0] - v[0]) ** 2 + (c[1] - v[1]) ** 2) / sigma**2),
        "yaw_rate": math.exp(-((c[2] - w[2]) ** 2) / sigma**2),
        "vertical_velocity": float(v[2]) ** 2,
        "roll_pitch_rate": square(w[:2]),
        "orientation": square(m.gravity[k, :2]),
        "torque": square(m.torques[k]),
        "joint_acceleration": square(m.joint_acceleration[k]),
        "action_rate": square(m.action[k] - m.last_action[k]),
        "action": square(m.action[k]),
        "collision": float(sum(m.touches[k])),
        "slip": sum(float(s) ** 2 for s, stands in zip(m.foot_speed[k], m.stands[k], strict=True) if stands),
        "fall": float(m.fallen[k]),
    }


def test_terms_are_their_formulas():
    m = motion()
    found = terms(m, 0.25)
    for k in range(3):
        for name, expected in by_hand(m, k, 0.25).items():
            assert float(found[name][k]) == pytest.approx(expected, rel=1e-4, abs=1e-6), name


@pytest.mark.parametrize("bonus", [0.0, 50.0])
def test_the_reward_is_the_weighted_sum_over_the_step_but_not_negative_and_a_fall_counts_once(bonus):
    m, cfg = motion(1), RewardConfig(collision=bonus)
    value, weighted = reward(m, cfg, 0.02)
    for k in range(3):
        found = by_hand(m, k, cfg.tracking_sigma)
        moving = sum(getattr(cfg, n) * v * 0.02 for n, v in found.items() if n != "fall")
        assert float(value[k]) == pytest.approx(max(0.0, moving) + cfg.fall * found["fall"], rel=1e-4)
        assert (moving > 0) == (bonus > 0), "both cases are tested"
    assert weighted["fall"].tolist() == [cfg.fall, 0.0, 0.0]
