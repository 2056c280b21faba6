"""An observation term for mjlab: the height scan of a map that a RayCastSensor builds.

    python examples/mjlab_term.py --picture map.png

Written from the documentation of mjlab 1.6 and run against the stand-ins of `stand_ins.py`: not tried with the
simulator itself. Copy `MapScan` and `MAP_SCAN` into your task, and use them in place of the term `height_scan`. Give
the scene a RayCastSensor named "rays" on the robot that looks ahead and down, such as one with a
`PinholeCameraPatternCfg`, and not one that looks straight down from above: that one sees through everything.
"""

import argparse

import torch

from torchelev import ElevationMap, ElevationMapConfig, GridConfig, HeightScan
from torchelev.frames import transform
from torchelev.viz.plot import Panel, save_layers

try:
    from mjlab.managers import ManagerTermBase, ObservationTermCfg
except ImportError:
    from stand_ins import MjlabTermBase as ManagerTermBase
    from stand_ins import ObservationTermCfg

CFG = ElevationMapConfig(grid=GridConfig(resolution=0.05, length_x=4.0, length_y=4.0))


class MapScan(ManagerTermBase):
    """187 heights in the order and scale of mjlab's `height_scan`, read from each environment's own map."""

    def __init__(self, cfg, env):
        super().__init__(env)
        self.emap = ElevationMap(CFG, num_envs=env.num_envs, device=env.device)
        self.scan = HeightScan.mjlab(standing_height=0.5)  # your robot's base above flat ground [m]
        self.updated = -1

    def reset(self, env_ids=None):
        self.emap.reset(None if env_ids is None or isinstance(env_ids, slice) else env_ids)

    def __call__(self, env, entity, sensor):
        robot, rays = env.scene[entity].data, env.scene[sensor].data
        T_map_base = transform(robot.root_link_pos_w, robot.root_link_quat_w)  # mjlab's quaternions are w x y z
        T_map_sensor = transform(rays.pos_w, rays.quat_w)
        # mjlab gives hits in the world frame, the map expects the sensor frame. A miss has distance -1 and becomes NaN,
        # which the map ignores.
        points = (rays.hit_pos_w - rays.pos_w[:, None]) @ T_map_sensor[:, :3, :3]
        points = points.where((rays.distances >= 0)[..., None], torch.nan)
        if self.updated != env.common_step_counter:  # another observation group may ask again within the step
            self.updated = env.common_step_counter
            self.emap.update(points, T_map_sensor, T_map_base, dt=env.step_dt)
        values, valid = self.scan(self.emap, T_map_base)
        return values  # or torch.cat([values, valid.float()], -1), to tell the policy what is known


MAP_SCAN = ObservationTermCfg(func=MapScan, params={"entity": "robot", "sensor": "rays"})

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
    print(
        f"observation {tuple(observation.shape)}, from {float(observation.min()):.2f} to {float(observation.max()):.2f}"
    )
    if args.picture:
        layers = {name: term.emap.layer(name)[5].numpy() for name in ("elevation", "upper_bound", "traversability")}
        panels = [Panel(title=name, values=values) for name, values in layers.items()]
        save_layers(args.picture, panels, extent=(-2, 2, -2, 2), title="One of eight maps, robot in the middle")
    term.reset(env_ids=torch.tensor([0, 2]))
