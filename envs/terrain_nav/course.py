"""The course of TerrainNav, with the traversability of its true ground."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass

import torch
from torch import Tensor

from torchelev import ElevationMap, ElevationMapConfig, GridConfig
from torchelev.pipeline import rate
from torchelev.sim import Course, CourseConfig, HeightField, Structures, make_course

_STRIDE = 2  # samples of the ground from one of the ceilings to the next


@dataclass(frozen=True, eq=False)
class Ceilings:
    """The lowest underside over the ground of each tile, on a grid."""

    heights: Tensor  #: (K, n, n) [m], inf where nothing hangs
    resolution: float  #: [m]

    def height(self, tile_ids: Tensor, xy: Tensor) -> Tensor:
        """Return the height (B, M) [m] at the samples nearest to xy (B, M, 2) [m], inf where nothing hangs."""
        n = self.heights.shape[-1]
        i, j = (xy / self.resolution + (n - 1) / 2).round().long().clamp(0, n - 1).unbind(-1)
        return self.heights.flatten()[(tile_ids[:, None] * n + i) * n + j]


@dataclass(frozen=True, eq=False)
class RatedCourse(Course):
    """A course with the traversability of its ground, for a critic that sees the truth."""

    traversability: HeightField  #: from 0 to 1, computed from the true ground as a map computes it
    ceilings: Ceilings | None = dataclasses.field(default=None, kw_only=True)  #: None for a course without structures


def make_rated_course(cfg: CourseConfig, device: torch.device | str = "cpu") -> RatedCourse:
    """Make the course of a config and the traversability of its ground; the same config makes the same course."""
    course = make_course(cfg, device)
    traversability = HeightField(_rate(course.field), cfg.resolution)
    parts = (course.field, course.starts, course.goals, traversability)
    if course.structures is None:
        return RatedCourse(*parts)
    ceilings = _find_ceilings(course.structures, course.field)
    return RatedCourse(*parts, structures=course.structures, ceilings=ceilings)


def _find_ceilings(structures: Structures, field: HeightField) -> Ceilings:
    """Return the undersides over some samples of the ground."""
    count, resolution = field.heights.shape[1], field.resolution
    axis = (torch.arange(0, count, _STRIDE, device=field.device) - (count - 1) / 2) * resolution
    xy = torch.stack(torch.meshgrid(axis, axis, indexing="ij"), -1).view(1, -1, 2)
    ground = field.heights[:, ::_STRIDE, ::_STRIDE].flatten(1)
    tiles = [
        structures.underside(torch.full((1,), k, device=field.device), xy, ground[k : k + 1])
        for k in range(field.num_tiles)
    ]
    return Ceilings(torch.cat(tiles).view(-1, len(axis), len(axis)), _STRIDE * resolution)


def _rate(field: HeightField) -> Tensor:
    """Return the analytic traversability (K, H, W) of the ground."""
    size = [n * field.resolution for n in field.heights.shape[1:]]
    grid = GridConfig(resolution=field.resolution, length_x=size[0], length_y=size[1])
    emap = ElevationMap(ElevationMapConfig(grid=grid), field.num_tiles, field.device)
    known = emap.state._replace(elevation=field.heights, validity=torch.ones_like(emap.state.validity))
    return rate(known, emap.cfg).traversability
