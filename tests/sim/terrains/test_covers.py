"""Courses of rooms: what stands in them, and where routes lead."""

import dataclasses

import pytest
import torch

from torchelev.sim import CourseConfig, CoversConfig, make_course

COVERS = CoversConfig()
SMALL = CourseConfig(num_tiles=4, num_routes=16, covers=COVERS)
IDS = torch.arange(4)


def test_rooms_come_from_their_seed_and_leave_the_open_course_alone():
    one, same, other = (make_course(dataclasses.replace(SMALL, seed=seed)) for seed in (3, 3, 4))
    assert torch.equal(one.field.heights, same.field.heights) and torch.equal(one.starts, same.starts)
    assert torch.equal(one.structures.center, same.structures.center)
    assert not torch.equal(one.field.heights, other.field.heights)
    assert make_course(CourseConfig(num_tiles=1)).structures is None


def test_each_route_leads_through_a_wall_from_a_free_place_to_a_free_place():
    course = make_course(SMALL)
    walls = torch.tensor([-2.0, 2.0])
    starts, goals = (torch.bucketize(places[..., 0].contiguous(), walls) for places in (course.starts, course.goals))
    assert bool((starts != goals).all())
    for places in (course.starts, course.goals):
        for k in range(places.shape[1]):
            yaw, zero = torch.full((4,), 0.3), torch.zeros(4)
            meets = course.structures.meets(IDS, places[:, k], yaw, (0.6, 0.4), zero - 1, zero + 2)
            assert not bool(meets.any())


def test_gates_are_low_and_high_in_turn_and_the_wall_is_open_there():
    course = make_course(dataclasses.replace(SMALL, roughness=0.0))
    for tile in range(4):
        center, half = course.structures.center[tile], course.structures.half_size[tile]
        is_lintel = ((center[:, 2] + half[:, 2] - COVERS.wall_height).abs() < 1e-3) & (half[:, 2] > 0)
        free = (center - half)[is_lintel, 2]
        is_low = free <= COVERS.low[1] + 1e-4
        assert bool(((free >= COVERS.low[0]) & is_low | (free >= COVERS.high[0]) & (free <= COVERS.high[1])).all())
        for wall in center[is_lintel, 0].unique():
            own = is_low[center[is_lintel, 0] == wall]
            pairs = own[: len(own) // 2 * 2].view(-1, 2)
            assert bool((pairs.sum(1) == 1).all()), "one of each pair is low"
        heights = course.field.height(IDS[tile : tile + 1], center[None, is_lintel, :2])
        assert float(heights.max()) < 0.01
    assert float(course.field.heights.max()) == pytest.approx(COVERS.wall_height)


def test_bad_settings_are_refused():
    with pytest.raises(ValueError, match="CoversConfig.low, high, wall_height: must be ordered"):
        CoversConfig(low=(0.3, 0.9))
    with pytest.raises(ValueError, match="CoversConfig.gate_width: must be below gate_spacing"):
        CoversConfig(gate_width=(1.0, 2.5))
    with pytest.raises(ValueError, match="CoversConfig.table_share, beam_share: must sum to at most 1"):
        CoversConfig(table_share=0.8, beam_share=0.3)
    with pytest.raises(ValueError, match="CoversConfig.wall_spacing: must be a positive number"):
        CoversConfig(wall_spacing=0.0)
