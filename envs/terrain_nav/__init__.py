"""TerrainNav: the paper's local navigation as a reinforcement learning task.

`task.py` is the task itself, as tensors. `gym.py` and `rsl_rl.py` are its interfaces to gymnasium and rsl-rl.
"""

from envs.terrain_nav.config import BodyConfig, RewardConfig, SightConfig, TerrainNavConfig
from envs.terrain_nav.task import TerrainNav
from torchelev.sim import CourseConfig

__all__ = ["CourseConfig", "RewardConfig", "BodyConfig", "SightConfig", "TerrainNav", "TerrainNavConfig"]
