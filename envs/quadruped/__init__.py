"""A quadruped on rough ground, in MuJoCo, that sees through its map.

`task.py` is the task itself, as tensors; `physics.py` is MuJoCo's part, which `robots.py` reads. Its interfaces to
gymnasium and rsl-rl are `gym.py` and `rsl_rl.py`.
"""

from envs.quadruped.config import QuadrupedConfig
from envs.quadruped.task import Quadruped

__all__ = ["Quadruped", "QuadrupedConfig"]
