"""The covered course of `python -m training.nav --course covered`: walls with gates, tables and beams."""

from __future__ import annotations

from envs.terrain_nav import CourseConfig, SightConfig
from torchelev.sim import CoversConfig

COURSES = ("open", "covered")


def covered_course(seed: int) -> CourseConfig:
    """Return the course, whose routes lead through one wall or two."""
    return CourseConfig(seed=seed, covers=CoversConfig(), distance=(3.0, 5.0))


def covered_sight(fill: str, ceilings: str) -> SightConfig:
    """Return the robots' sight there: their cameras look up nearly as far as down, from +40 to -50 degrees."""
    return SightConfig(
        fill=fill,
        ceilings=ceilings,
        camera_pixels=(16, 24),
        camera_fov_deg=(90.0, 90.0),
        camera_pitch_deg=5.0,
    )
