"""An observation term for mjlab: the height scan of a map that a depth camera builds, in the task for the Go1.

    python examples/mjlab_term.py --picture map.png

Robots stand on mjlab's rough terrain, on a CPU. Copy `MapScan`, `add_camera` and the lines of `make_config` into your
task. Needs `pip install mjlab==1.6.0`: `make test-mjlab` runs this in an environment of its own.
"""

import argparse

import numpy as np
import torch

from torchelev import ElevationMapConfig, GridConfig, HeightScan
from torchelev.integrations.mjlab import MapObservation

try:
    from mjlab.envs import ManagerBasedRlEnv
    from mjlab.managers import ObservationTermCfg
    from mjlab.sensor import ObjRef, PinholeCameraPatternCfg, RayCastSensorCfg
    from mjlab.tasks.velocity.config.go1.env_cfgs import unitree_go1_rough_env_cfg
except ImportError:
    ManagerBasedRlEnv = None


class MapScan(MapObservation):
    """187 heights in the order and scale of mjlab's `height_scan`, read from each environment's own map."""

    read = HeightScan.mjlab(standing_height=0.3)  # your robot's base above flat ground [m]
    map_cfg = ElevationMapConfig(grid=GridConfig(resolution=0.05, length_x=4.0, length_y=4.0))
    with_validity = False  # True also gives the policy a mask of the known points


def add_camera(spec):
    """Put a site into the head that looks 40 degrees down: its x is right, y up, z backward."""
    quat = (0.6409, 0.2988, -0.2988, -0.6409)  # w x y z
    spec.body("robot/trunk").add_site(name="robot/eye", pos=(0.28, 0.0, 0.06), quat=quat)


def make_config(num_envs):
    """Return the config of the task with a camera, and the map in place of the ideal scan."""
    cfg = unitree_go1_rough_env_cfg()
    cfg.scene.num_envs, cfg.seed, cfg.scene.spec_fn = num_envs, 0, add_camera
    eye = ObjRef(type="site", name="eye", entity="robot")
    pattern = PinholeCameraPatternCfg(width=64, height=48, fovy=58.0)
    only_ground = {"max_distance": 4.0, "include_geom_groups": (0,)}
    cfg.scene.sensors += (RayCastSensorCfg(name="camera", frame=eye, pattern=pattern, **only_ground),)
    term = ObservationTermCfg(func=MapScan, params={"sensor_name": "camera"})
    cfg.observations["actor"].terms["height_scan"] = term
    return cfg


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--steps", type=int, default=40)
    parser.add_argument("--picture", help="file to write")
    args = parser.parse_args()
    if ManagerBasedRlEnv is None:
        parser.exit(2, "This example needs mjlab: pip install mjlab==1.6.0, or make test-mjlab.\n")

    env = ManagerBasedRlEnv(make_config(num_envs=8), device="cpu")
    env.reset()
    for _ in range(args.steps):
        observed, *_ = env.step(0.3 * torch.randn(8, 12))
    scan = observed["actor"][:, -187:]
    print(f"observation {tuple(scan.shape)}, from {scan.min():.2f} to {scan.max():.2f}")
    if args.picture:
        from torchelev.viz.plot import Panel, save_layers  # needs the extra io

        emap = env.observation_manager.get_term_cfg("actor", "height_scan").func.emap
        elevation = emap.layer("elevation").numpy()
        relief = np.nanmax(elevation, (1, 2)) - np.nanmin(elevation, (1, 2))
        roughest = np.argsort(relief)[-3:]
        panels = [Panel(title=f"environment {k}: elevation", values=elevation[k], unit="m") for k in roughest]
        save_layers(args.picture, panels, extent=(-2, 2, -2, 2), title="Three of eight maps, robots in the middle")
    env.close()
