"""An observation term for Isaac Lab: the height scan of a map that depth cameras build.

    python examples/isaac_lab_term.py --picture map.png

Where Isaac Lab 3.0 is installed, it runs there, in the task of `benchmarks/quality/isaac_lab`: quadrupeds stand on
rough terrain, on a CPU and without Isaac Sim. Elsewhere it runs against `stand_ins.py`, which stands for the parts of
an environment that the term reads: the scene with its sensors, and the counter of steps. Copy `MapScan` and `MAP_SCAN`
into your task, and use them in place of `mdp.height_scan`:

    class PolicyCfg(ObservationGroupCfg):
        height_scan = MAP_SCAN
"""

import argparse

import torch

from torchelev import ElevationMapConfig, GridConfig, HeightScan
from torchelev.integrations.isaac_lab import MapObservation
from torchelev.viz.plot import Panel, save_layers

try:
    from isaaclab.managers import ObservationTermCfg, SceneEntityCfg
except ImportError:
    from stand_ins import Environment, ObservationTermCfg, SceneEntityCfg

    Simulator = None
else:
    from isaaclab.envs import ManagerBasedRLEnv as Simulator


class MapScan(MapObservation):
    """187 heights in the order, offset and clip of `mdp.height_scan`, read from each environment's own map."""

    read = HeightScan.isaac_lab(standing_height=0.5)  # your robot's base above flat ground [m]
    map_cfg = ElevationMapConfig(grid=GridConfig(resolution=0.05, length_x=4.0, length_y=4.0))


MAP_SCAN = ObservationTermCfg(func=MapScan, params={"sensor_cfg": SceneEntityCfg("camera")})


def run_simulator(num_envs, steps):
    """Isaac Lab: return the last observation and the maps."""
    from benchmarks.quality.isaac_lab.task import MapEnvCfg, find_term

    cfg = MapEnvCfg()
    cfg.scene.num_envs, cfg.observations.policy.height_scan = num_envs, MAP_SCAN
    env = Simulator(cfg)
    env.reset()
    for _ in range(steps):
        observed, *_ = env.step(torch.zeros(num_envs, 12))
    return observed["policy"][:, -187:], find_term(env, "policy", "height_scan").func.emap


def run_stand_ins(num_envs, steps):
    """Do what Isaac Lab's observation manager does; return the last observation and the maps."""
    env = Environment(num_envs)
    term = MAP_SCAN.func(MAP_SCAN, env)
    for _ in range(steps):
        env.step()
        observed = term(env, **MAP_SCAN.params)
    return observed, term.emap


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--steps", type=int, default=40)
    parser.add_argument("--picture", help="file to write")
    args = parser.parse_args()

    observation, emap = (run_simulator if Simulator else run_stand_ins)(8, args.steps)
    print(f"observation {tuple(observation.shape)}, from {observation.min():.2f} to {observation.max():.2f}")
    if args.picture:
        elevation = emap.layer("elevation").numpy()
        panels = [Panel(title=f"environment {k}: elevation", values=elevation[k], unit="m") for k in (0, 3, 7)]
        save_layers(args.picture, panels, extent=(-2, 2, -2, 2), title="Three of eight maps, robots in the middle")
