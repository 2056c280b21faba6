"""Maps of the environments of a Genesis scene: robots float past stairs, and a lidar and a depth camera on each look.

    python examples/genesis_maps.py --picture map.png

Needs `pip install genesis-world`: `make test-genesis` runs this in an environment of its own.
"""

import argparse

import torch

from torchelev import BodyConfig, ElevationMapConfig, GridConfig, HeightScan, SensorConfig
from torchelev.integrations.genesis import GenesisMaps

try:
    import genesis as gs
except ImportError:
    gs = None

STAIRS = [(1.0 + 0.4 * k, 0.08 * (k + 1)) for k in range(4)]  # x and height of each step [m]


def make_scene(num_envs):
    """Return a scene with stairs, the robot's base link and its sensors."""
    gs.init(backend=gs.cpu, logging_level="error")
    scene = gs.Scene(show_viewer=False, sim_options=gs.options.SimOptions(dt=0.02, gravity=(0.0, 0.0, 0.0)))
    scene.add_entity(gs.morphs.Plane())
    for x, height in STAIRS:
        scene.add_entity(gs.morphs.Box(pos=(x, 0.0, height / 2), size=(0.4, 1.6, height), fixed=True))
    robot = scene.add_entity(gs.morphs.Box(pos=(0.0, 0.0, 0.6), size=(0.4, 0.2, 0.1)))
    on_robot = {"entity_idx": robot.idx, "link_idx_local": 0, "max_range": 8.0}
    lidar = gs.sensors.Lidar(pattern=gs.sensors.SphericalPattern(n_points=(32, 64)), pos_offset=(0, 0, 0.3), **on_robot)
    pattern = gs.sensors.DepthCameraPattern(res=(64, 48), fov_horizontal=70.0)
    place = {"pos_offset": (0.3, 0.0, 0.1), "euler_offset": (0.0, 40.0, 0.0)}  # [m], [deg] down
    camera = gs.sensors.DepthCamera(pattern=pattern, **place, **on_robot)
    sensors = [scene.add_sensor(lidar), scene.add_sensor(camera)]
    scene.build(n_envs=num_envs)
    return scene, robot, sensors


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--steps", type=int, default=30)
    parser.add_argument("--picture", help="file to write")
    args = parser.parse_args()
    if gs is None:
        parser.exit(2, "This example needs Genesis: pip install genesis-world, or make test-genesis.\n")

    scene, robot, sensors = make_scene(num_envs=3)
    body = BodyConfig(lower=(-0.25, -0.15, -0.1), upper=(0.25, 0.15, 0.1))  # rays hit the robot, too
    grid = GridConfig(resolution=0.05, length_x=4.0, length_y=4.0)
    maps = GenesisMaps(robot.links[0], sensors, ElevationMapConfig(grid=grid, sensor=SensorConfig(body=body)))
    scan = HeightScan.isaac_lab()
    robot.set_dofs_velocity(torch.tensor([[0.0], [0.5], [1.0]]), dofs_idx_local=[0])  # [m/s] towards the stairs
    for _ in range(args.steps):
        scene.step()
        maps.update(dt=0.02)
        values, valid = scan(maps.emap, maps.T_map_base)
    print(f"height scans {tuple(values.shape)}, {float(valid.float().mean()):.0%} of their points are known")
    if args.picture:
        from torchelev.viz.plot import Panel, save_layers  # needs the extra io

        elevation = maps.emap.layer("elevation").numpy()
        panels = [Panel(title=f"environment {k}: elevation", values=elevation[k], unit="m") for k in range(3)]
        save_layers(args.picture, panels, extent=(-2, 2, -2, 2), title="Three environments, robots in the middle")
