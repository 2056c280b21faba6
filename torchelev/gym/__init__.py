"""Maps for gymnasium environments: observation wrappers, a feed from any simulator, and rsl-rl's `VecEnv`.

Environments and tasks are not here: bring your own, or see `envs/` in a checkout. Needs gymnasium
(``pip install 'torchelev[gym]'``). `torchelev.gym.rsl_rl` also needs rsl-rl; import it by that name.
"""

try:
    import gymnasium  # noqa: F401
except ImportError as error:
    raise ImportError("torchelev.gym: needs gymnasium; install it with pip install 'torchelev[gym]'") from error

from torchelev.gym.feed import MapFeed
from torchelev.gym.wrappers import ElevationMapObservation, VectorElevationMapObservation

__all__ = ["ElevationMapObservation", "MapFeed", "VectorElevationMapObservation"]
