"""An existing gymnasium environment with a map observation: MuJoCo's Ant among boxes.

    python examples/gymnasium_observation.py --picture map.png

The environment's code is not touched: a wrapper calls three functions, which return its points and poses, and adds the
map to the observation. Needs `pip install 'torchelev[gym]' 'gymnasium[mujoco]'`.
"""

import argparse
import tempfile
from pathlib import Path

import gymnasium
import mujoco
import numpy as np
import torch
from gymnasium.envs.mujoco import ant_v5

from torchelev import ElevationMapConfig, GridConfig
from torchelev.frames import transform_matrix
from torchelev.gym import ElevationMapObservation
from torchelev.sim import DepthCamera, mount
from torchelev.viz.plot import Panel, save_layers

RAYS, MAX_RANGE = DepthCamera(width=64, height=48).directions.numpy(), 6.0  # (N, 3) x forward, y left, z up; [m]
T_BASE_SENSORS = torch.stack([mount(pitch_deg=35, z=0.3, yaw_deg=yaw) for yaw in (0, 90, 180, 270)])  # (4, 4, 4)
BOXES = [(1.6, 0.6, 0.15), (-1.5, 1.2, 0.3), (0.3, -1.8, 0.25), (-1.2, -1.4, 0.1)]  # x, y, half height [m]


def make_ant_among_boxes():
    xml = Path(ant_v5.__file__).parent.joinpath("assets/ant.xml").read_text()
    boxes = "".join(f'<geom type="box" size=".4 .3 {h}" pos="{x} {y} {h}" conaffinity="1"/>' for x, y, h in BOXES)
    with tempfile.NamedTemporaryFile("w", suffix=".xml") as file:
        print(xml.replace("</worldbody>", boxes + "</worldbody>"), file=file, flush=True)
        return gymnasium.make("Ant-v5", xml_file=file.name, terminate_when_unhealthy=False)


def T_map_base(env):
    return transform_matrix(env.unwrapped.data.body("torso").xpos, env.unwrapped.data.body("torso").xmat)


def T_map_sensor(env):
    return T_map_base(env) @ T_BASE_SENSORS  # (4, 4, 4): four cameras


def points(env):
    """Return what the four cameras see, (4, N, 3) [m] in each one's frame; NaN for nothing and for the Ant's legs."""
    return np.stack([cast(env.unwrapped.model, env.unwrapped.data, T) for T in T_map_sensor(env).numpy()])


def cast(model, data, T):
    geom, distance = np.zeros(len(RAYS), np.int32), np.zeros(len(RAYS))
    directions, torso = (RAYS @ T[:3, :3].T).ravel(), model.body("torso").id
    skipped = None, 1, torso  # no groups of geoms, static ones too, and not the robot's own torso
    mujoco.mj_multiRay(model, data, T[:3, 3].copy(), directions, *skipped, geom, distance, None, len(RAYS), MAX_RANGE)
    is_world = (geom >= 0) & (model.geom_bodyid[geom] == 0)  # the world's own geoms are body 0
    return np.where(is_world & (distance <= MAX_RANGE), distance, np.nan)[:, None] * RAYS


parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
parser.add_argument("--steps", type=int, default=60)
parser.add_argument("--picture", help="file to write")
args = parser.parse_args()

ant = make_ant_among_boxes()
cfg = ElevationMapConfig(grid=GridConfig(resolution=0.05, length_x=6.0, length_y=6.0))
poses = {"T_map_sensor": T_map_sensor, "T_map_base": T_map_base}
env = ElevationMapObservation(ant, points=points, **poses, dt=ant.unwrapped.dt, cfg=cfg)
observation, info = env.reset(seed=0)
env.action_space.seed(0)
for _ in range(args.steps):
    observation, reward, terminated, truncated, info = env.step(env.action_space.sample())  # your policy here
    if terminated or truncated:
        observation, info = env.reset()
print({name: value.shape for name, value in observation.items()})

if args.picture:
    x, y, _ = env.emap.center[0].tolist()
    panels = [Panel(title=f"{n} [m]", values=env.emap.layer(n)[0].numpy()) for n in ("elevation", "upper_bound")]
    save_layers(args.picture, panels, extent=(x - 3, x + 3, y - 3, y + 3), title="Ant's map: it is in the middle")
