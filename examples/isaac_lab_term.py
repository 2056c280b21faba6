"""An observation term for Isaac Lab: the height scan of a map that depth cameras build.

    python examples/isaac_lab_term.py --picture map.png

Quadrupeds stand on rough terrain in the task of `benchmarks/quality/isaac_lab`, on a CPU and without Isaac Sim. Needs
Isaac Lab 3.0: `make test-isaaclab` runs this in an environment of its own. Copy `MapScan` into your task, and use it in
place of `mdp.height_scan`:

    class PolicyCfg(ObservationGroupCfg):
        height_scan = ObservationTermCfg(func=MapScan, params={"sensor_cfg": SceneEntityCfg("camera")})
"""

import argparse

import torch

from torchelev import ElevationMapConfig, GridConfig, HeightScan
from torchelev.integrations.isaac_lab import MapObservation

try:
    from isaaclab.envs import ManagerBasedRLEnv
    from isaaclab.managers import ObservationTermCfg, SceneEntityCfg
except ImportError:
    ManagerBasedRLEnv = None


class MapScan(MapObservation):
    """187 heights in the order, offset and clip of `mdp.height_scan`, read from each environment's own map."""

    read = HeightScan.isaac_lab(standing_height=0.3)  # your robot's base above flat ground [m]
    map_cfg = ElevationMapConfig(grid=GridConfig(resolution=0.05, length_x=4.0, length_y=4.0))


def run(num_envs, steps):
    """Return the last observation and the maps."""
    from benchmarks.quality.isaac_lab.task import MapEnvCfg, find_term

    cfg = MapEnvCfg()
    cfg.scene.num_envs = num_envs
    term = ObservationTermCfg(func=MapScan, params={"sensor_cfg": SceneEntityCfg("camera")})
    cfg.observations.policy.height_scan = term
    env = ManagerBasedRLEnv(cfg)
    env.reset()
    for _ in range(steps):
        observed, *_ = env.step(torch.zeros(num_envs, 12))
    return observed["policy"][:, -187:], find_term(env, "policy", "height_scan").func.emap


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--steps", type=int, default=40)
    parser.add_argument("--picture", help="file to write")
    args = parser.parse_args()
    if ManagerBasedRLEnv is None:
        parser.exit(2, "This example needs Isaac Lab 3.0: make test-isaaclab, or docs/howto/isaac_lab.md.\n")

    observation, emap = run(8, args.steps)
    print(f"observation {tuple(observation.shape)}, from {observation.min():.2f} to {observation.max():.2f}")
    if args.picture:
        from torchelev.viz.plot import Panel, save_layers  # needs the extra io

        elevation = emap.layer("elevation").numpy()
        panels = [Panel(title=f"environment {k}: elevation", values=elevation[k], unit="m") for k in (0, 3, 7)]
        save_layers(args.picture, panels, extent=(-2, 2, -2, 2), title="Three of eight maps, robots in the middle")
