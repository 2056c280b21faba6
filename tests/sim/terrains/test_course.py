"""Obstacle courses: what a seed decides, where routes lead, and which settings are refused."""

import dataclasses
import math

import pytest
import torch

from torchelev.sim import CourseConfig, make_course

SMALL = CourseConfig(num_tiles=4, num_routes=16)


@pytest.mark.slow(1)
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


def test_obstacles_leave_gaps_and_bad_settings_are_refused():
    with pytest.raises(ValueError, match="CourseConfig.spacing: must leave a gap"):
        CourseConfig(spacing=1.0)
    with pytest.raises(ValueError, match="CourseConfig.shares"):
        CourseConfig(shares=(0.5, 0.5, 0.5))
