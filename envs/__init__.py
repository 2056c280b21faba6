"""Reinforcement learning environments built on torchelev. Application code: run from the checkout.

Importing this package registers `torchelev/TerrainNav-v0` with gymnasium, where that is installed;
`gymnasium.make("envs:torchelev/TerrainNav-v0")` imports it by itself. Trainings are in `training/`; wrappers for
environments of your own are in `torchelev.gym`.
"""

import contextlib

with contextlib.suppress(ImportError):
    import gymnasium

    if "torchelev/TerrainNav-v0" not in gymnasium.registry:
        gymnasium.register(
            id="torchelev/TerrainNav-v0",
            entry_point="envs.terrain_nav.gym:TerrainNavEnv",
            vector_entry_point="envs.terrain_nav.gym:TerrainNavVectorEnv",
        )
