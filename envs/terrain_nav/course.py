"""The course of TerrainNav, with the traversability of its true ground."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from torchelev import ElevationMap, ElevationMapConfig, GridConfig
from torchelev.pipeline import rate
from torchelev.sim import Course, CourseConfig, HeightField, make_course


@dataclass(frozen=True, eq=False)
class RatedCourse(Course):
    """A course with the traversability of its ground, for a critic that sees the truth."""

    traversability: HeightField  #: from 0 to 1, computed from the true ground as a map computes it


def make_rated_course(cfg: CourseConfig, device: torch.device | str = "cpu") -> RatedCourse:
    """Make the course of a config and the traversability of its ground; the same config makes the same course."""
    course = make_course(cfg, device)
    traversability = HeightField(_rate(course.field), cfg.resolution)
    return RatedCourse(course.field, course.starts, course.goals, traversability)


def _rate(field: HeightField) -> Tensor:
    """Return the analytic traversability (K, H, W) of the ground."""
    size = [n * field.resolution for n in field.heights.shape[1:]]
    grid = GridConfig(resolution=field.resolution, length_x=size[0], length_y=size[1])
    emap = ElevationMap(ElevationMapConfig(grid=grid), field.num_tiles, field.device)
    known = emap.state._replace(elevation=field.heights, validity=torch.ones_like(emap.state.validity))
    return rate(known, emap.cfg).traversability
