"""Maps for gymnasium environments: the observation wrappers, the feed from a simulator, and rsl-rl's `VecEnv`.

Environments and tasks are not here: they are the user's, or examples in a checkout's `envs/`. Needs gymnasium
(``pip install 'torchelev[gym]'``); `torchelev.gym.rsl_rl` needs rsl-rl too, and is imported by that name.
"""

try:
    import gymnasium  # noqa: F401
except ImportError as error:
    raise ImportError("torchelev.gym: needs gymnasium; install it with pip install 'torchelev[gym]'") from error

from torchelev.gym.feed import MapFeed
from torchelev.gym.wrappers import ElevationMapObservation, VectorElevationMapObservation

__all__ = ["ElevationMapObservation", "MapFeed", "VectorElevationMapObservation"]
