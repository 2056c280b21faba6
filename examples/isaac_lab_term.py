"""An observation term for Isaac Lab: the height scan of a map that depth cameras build.

    python examples/isaac_lab_term.py --picture map.png

Written from the documentation of Isaac Lab 2.3 and run against the stand-ins of `stand_ins.py`: not tried with the
simulator itself. Copy `MapScan` and `MAP_SCAN` into your task, and use them in place of `mdp.height_scan`:

    class PolicyCfg(ObservationGroupCfg):
        height_scan = MAP_SCAN

The camera needs `update_latest_camera_pose=True`, else its pose stays that of the start, and
`data_types=["distance_to_image_plane"]`; the environment `rerender_on_reset=True`, else the first image of an episode
is the last one of the episode before.
"""

import argparse

import torch

from torchelev import ElevationMap, ElevationMapConfig, GridConfig, HeightScan, depth_to_points
from torchelev.frames import transform
from torchelev.viz.plot import Panel, save_layers

try:
    from isaaclab.managers import ManagerTermBase, ObservationTermCfg, SceneEntityCfg
except ImportError:
    from stand_ins import ManagerTermBase, ObservationTermCfg, SceneEntityCfg

CFG = ElevationMapConfig(grid=GridConfig(resolution=0.05, length_x=4.0, length_y=4.0))


class MapScan(ManagerTermBase):
    """187 heights in the order, offset and clip of `mdp.height_scan`, read from each environment's own map."""

    def __init__(self, cfg, env):
        super().__init__(cfg, env)
        self.emap = ElevationMap(CFG, num_envs=env.num_envs, device=env.device)
        self.scan = HeightScan.isaac_lab(standing_height=0.5)  # your robot's base above flat ground [m]
        self.updated = -1

    def reset(self, env_ids=None):
        some = None if env_ids is None or isinstance(env_ids, slice) else env_ids
        self.emap.reset(some if some is None else torch.as_tensor(some, device=self.emap.device))

    def __call__(self, env, asset_cfg, camera_cfg):
        # Isaac Lab 3 gives quaternions x y z w and Warp arrays: use `transform_xyzw` and `wp.to_torch`.
        robot, camera = env.scene[asset_cfg.name].data, env.scene[camera_cfg.name].data
        T_map_base = transform(robot.root_pos_w, robot.root_quat_w)
        T_map_camera = transform(camera.pos_w, camera.quat_w_ros)  # the optical axes of `depth_to_points`
        depth = camera.output["distance_to_image_plane"].squeeze(-1)  # (B, h, w) [m], inf: nothing
        points = depth_to_points(depth, camera.intrinsic_matrices)
        if self.updated != env.common_step_counter:  # another observation group may ask again within the step
            self.updated = env.common_step_counter
            self.emap.update(points, T_map_camera, T_map_base, dt=env.step_dt)
        return self.scan(self.emap, T_map_base)[0]  # [1] tells the policy what is known


MAP_SCAN = ObservationTermCfg(
    func=MapScan, params={"asset_cfg": SceneEntityCfg("robot"), "camera_cfg": SceneEntityCfg("camera")}
)

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
