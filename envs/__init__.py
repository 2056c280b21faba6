"""Reinforcement learning environments built on torchelev. Application code: run from the checkout.

Importing this package registers `torchelev/TerrainNav-v0` and `torchelev/Quadruped-v0` with gymnasium, where that is
installed; `gymnasium.make("envs:torchelev/TerrainNav-v0")` imports it by itself. Trainings are in `training/`; wrappers
for environments of your own are in `torchelev.gym`.
"""

import contextlib

with contextlib.suppress(ImportError):
    import gymnasium

    for name, room in (("TerrainNav", "terrain_nav"), ("Quadruped", "quadruped")):
        if f"torchelev/{name}-v0" not in gymnasium.registry:
            gymnasium.register(
                id=f"torchelev/{name}-v0",
                entry_point=f"envs.{room}.gym:{name}Env",
                vector_entry_point=f"envs.{room}.gym:{name}VectorEnv",
            )
