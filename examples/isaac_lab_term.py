"""An observation term for Isaac Lab: the height scan of a map that depth cameras build.

    python examples/isaac_lab_term.py --picture map.png

Written from the documentation of Isaac Lab 2.3 and 3.0 and run against the stand-ins of `stand_ins.py`: not tried with
the simulator itself. Copy `MapScan` and `MAP_SCAN` into your task, and use them in place of `mdp.height_scan`:

    class PolicyCfg(ObservationGroupCfg):
        height_scan = MAP_SCAN

A rendered camera needs `update_latest_camera_pose=True`, else its pose stays that of the start, and
`data_types=["distance_to_image_plane"]`; the environment `rerender_on_reset=True`, else the first image of an episode
is the last one of the episode before.
"""

import argparse

import torch

from torchelev import ElevationMapConfig, GridConfig, HeightScan
from torchelev.integrations.isaac_lab import MapObservation
from torchelev.viz.plot import Panel, save_layers

try:
    from isaaclab.managers import ObservationTermCfg, SceneEntityCfg
except ImportError:
    from stand_ins import ObservationTermCfg, SceneEntityCfg


class MapScan(MapObservation):
    """187 heights in the order, offset and clip of `mdp.height_scan`, read from each environment's own map."""

    read = HeightScan.isaac_lab(standing_height=0.5)  # your robot's base above flat ground [m]
    map_cfg = ElevationMapConfig(grid=GridConfig(resolution=0.05, length_x=4.0, length_y=4.0))


MAP_SCAN = ObservationTermCfg(func=MapScan, params={"sensor_cfg": SceneEntityCfg("camera")})

if __name__ == "__main__":
    from stand_ins import Environment

    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--steps", type=int, default=40)
    parser.add_argument("--picture", help="file to write")
    args = parser.parse_args()

    env = Environment(num_envs=8)
    term = MAP_SCAN.func(MAP_SCAN, env)  # the observation manager does this, and calls the term in each step
    for _ in range(args.steps):
        env.step()
        observation = term(env, **MAP_SCAN.params)
    print(f"observation {tuple(observation.shape)}, from {observation.min():.2f} to {observation.max():.2f}")
    if args.picture:
        elevation = term.emap.layer("elevation").numpy()
        panels = [Panel(title=f"environment {k}: elevation", values=elevation[k], unit="m") for k in (0, 3, 7)]
        save_layers(args.picture, panels, extent=(-2, 2, -2, 2), title="Three of eight maps, robots in the middle")
    term.reset(env_ids=torch.tensor([0, 2]))
