"""TerrainNav: the paper's local navigation, as a task for reinforcement learning."""

from envs.terrain_nav.config import BodyConfig, RewardConfig, SightConfig, TerrainNavConfig
from envs.terrain_nav.task import TerrainNav
from torchelev.sim import CourseConfig

__all__ = ["CourseConfig", "RewardConfig", "BodyConfig", "SightConfig", "TerrainNav", "TerrainNavConfig"]
