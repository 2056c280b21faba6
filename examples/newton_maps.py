"""Maps of the worlds of a Newton model: boxes fall towards rough ground, and a lidar and a depth camera on each look.

    python examples/newton_maps.py --picture map.png

The ground is a mesh. Needs `pip install newton`: `make test-newton` runs this in an environment of its own.
"""

import argparse

import torch

from torchelev import ElevationMapConfig, GridConfig, HeightScan
from torchelev.integrations.newton import NewtonCamera, NewtonLidar, NewtonMaps
from torchelev.sim import Lidar, make_terrain, mount

try:
    import newton
    import warp as wp
except ImportError:
    newton = None

RESOLUTION, SIDE = 0.1, 8.0  # [m] of the ground
DT = 0.02  # [s]


def make_ground():
    """Return rough ground as a mesh of two triangles for each cell."""
    heights = make_terrain("rough", torch.tensor([0.8]), length=SIDE, resolution=RESOLUTION, seed=1).field.heights[0]
    n = len(heights)
    axis = RESOLUTION * (torch.arange(n) - (n - 1) / 2)
    vertices = torch.stack([*torch.meshgrid(axis, axis, indexing="ij"), heights], -1)
    corner = (torch.arange(n - 1)[:, None] * n + torch.arange(n - 1)).flatten()
    faces = torch.stack([corner, corner + n, corner + n + 1, corner, corner + n + 1, corner + 1], -1)
    return newton.Mesh(vertices.view(-1, 3).numpy(), faces.flatten().int().numpy())


def make_model(worlds):
    """Return a model in whose worlds a box hangs 1.5 m above the ground."""
    robot = newton.ModelBuilder()
    base = robot.add_body(xform=wp.transform((0.0, 0.0, 1.5), wp.quat_identity()), label="base")
    robot.add_shape_box(base, hx=0.2, hy=0.1, hz=0.05)
    scene = newton.ModelBuilder()
    scene.replicate(robot, worlds)
    scene.add_shape_mesh(-1, mesh=make_ground())
    return scene.finalize(device="cpu")


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--steps", type=int, default=30)
    parser.add_argument("--picture", help="file to write")
    args = parser.parse_args()
    if newton is None:
        parser.exit(2, "This example needs Newton: pip install newton, or make test-newton.\n")

    model = make_model(worlds=3)
    solver, state, control = newton.solvers.SolverXPBD(model), model.state(), model.control()
    wp.to_torch(state.body_qd)[:, :3] = torch.tensor([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]])  # [m/s]
    directions = torch.nn.functional.normalize(Lidar(rings=24, azimuths=180).directions.float(), dim=-1)
    camera = NewtonCamera(width=64, height=48, fov=1.0, T_base_sensor=mount(pitch_deg=45.0, x=0.25, z=0.1))
    sensors = [NewtonLidar(directions, mount(pitch_deg=0.0, z=0.2)), camera]
    cfg = ElevationMapConfig(grid=GridConfig(resolution=0.05, length_x=4.0, length_y=4.0))
    maps, scan = NewtonMaps(model, "base", sensors, cfg), HeightScan.isaac_lab()
    for _ in range(args.steps):
        after = model.state()
        solver.step(state, after, control, None, DT)  # no contacts: they fall
        state = after
        maps.update(state, DT)
        values, valid = scan(maps.emap, maps.T_map_base)
    print(f"height scans {tuple(values.shape)}, {float(valid.float().mean()):.0%} of their points are known")
    if args.picture:
        from torchelev.viz.plot import Panel, save_layers  # needs the extra io

        elevation = maps.emap.layer("elevation").numpy()
        panels = [Panel(title=f"world {k}: elevation", values=elevation[k], unit="m") for k in range(3)]
        save_layers(args.picture, panels, extent=(-2, 2, -2, 2), title="Three worlds, robots in the middle")
