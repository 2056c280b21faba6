"""A MuJoCo scene with a depth camera, and the map in the loop.

    python examples/mujoco_depth_camera.py --picture map.png

A camera rides towards stairs and boxes. MuJoCo renders what it sees, and the map fuses it. Needs `pip install mujoco`.
Where OpenGL cannot be had, not even without a screen, rays are cast in place of rendering.
"""

import argparse
import math
import os

import numpy as np
import torch

from torchelev import ElevationMap, ElevationMapConfig, GridConfig, depth_to_points
from torchelev.frames import transform_matrix
from torchelev.viz.plot import Panel, save_layers

os.environ.setdefault("MUJOCO_GL", "egl")  # render without a screen; read when mujoco is imported
try:
    import mujoco
except (ImportError, AttributeError):  # no EGL here
    os.environ["MUJOCO_GL"] = "disable"
    import mujoco

WIDTH, HEIGHT, FOV_Y, MAX_RANGE = 160, 120, 58.0, 6.0  # [pixels], [pixels], [deg], [m]
STAIRS = "".join(f'<geom type="box" size=".15 1 {0.06 * k}" pos="{1.2 + 0.3 * k} 0 {0.06 * k}"/>' for k in (1, 2, 3))
BOXES = '<geom type="box" size=".2 .3 .2" pos=".6 1.3 .2"/><geom type="box" size=".3 .2 .1" pos="1 -1.4 .1"/>'
SCENE = f"""<mujoco><worldbody><geom type="plane" size="9 9 .1"/>
  {STAIRS}{BOXES}<body name="your_robot" mocap="true">
  <camera name="front" pos=".3 0 .2" xyaxes="0 -1 0 .574 0 .819" fovy="{FOV_Y}"/></body></worldbody></mujoco>"""
FOCAL = HEIGHT / 2 / math.tan(math.radians(FOV_Y) / 2)  # [pixels]
K = torch.tensor([[FOCAL, 0, (WIDTH - 1) / 2], [0, FOCAL, (HEIGHT - 1) / 2], [0, 0, 1]])


def make_renderer(model):
    try:
        renderer = mujoco.Renderer(model, HEIGHT, WIDTH)
        return renderer.enable_depth_rendering() or renderer
    except Exception as error:  # its type differs by platform
        print(f"MuJoCo cannot render here ({error!r}): casting rays in place of rendering")


def see(model, data, renderer):
    """Return the points (1, N, 3) [m] in the camera's own axes, NaN where nothing is within range."""
    if renderer:
        renderer.update_scene(data, camera="front")
        depth = torch.from_numpy(renderer.render())  # [m] along the viewing direction
        return depth_to_points(depth.where(depth < MAX_RANGE, torch.nan), K, frame="opengl")[None]
    rays = depth_to_points(torch.ones(HEIGHT, WIDTH), K, frame="opengl").double().numpy()
    rays /= np.linalg.norm(rays, axis=1, keepdims=True)
    world = (rays @ data.cam_xmat[0].reshape(3, 3).T).ravel()
    geom, distance = results = np.zeros(len(rays), np.int32), np.zeros(len(rays))
    mujoco.mj_multiRay(model, data, data.cam_xpos[0], world, None, 1, -1, *results, None, len(rays), MAX_RANGE)
    hit = np.where((geom < 0) | (distance > MAX_RANGE), np.nan, distance)  # the cutoff alone does not end rays
    return torch.from_numpy(hit[:, None] * rays).float()[None]


parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
parser.add_argument("--steps", type=int, default=40)
parser.add_argument("--picture", help="file to write")
args = parser.parse_args()

model = mujoco.MjModel.from_xml_string(SCENE)
data, renderer = mujoco.MjData(model), make_renderer(model)
emap = ElevationMap(ElevationMapConfig(grid=GridConfig(resolution=0.04, length_x=6.0, length_y=4.8)))
for step in range(args.steps):
    data.mocap_pos[0] = (-1.0 + 1.6 * step / args.steps, 0.3 * math.sin(step / 6), 0.55)
    mujoco.mj_forward(model, data)  # after mj_step, too: it leaves the cameras where they were before it
    T_map_camera = transform_matrix(data.cam_xpos, data.cam_xmat)  # (1, 4, 4): the scene has one camera
    emap.update(see(model, data, renderer), T_map_camera, transform_matrix(data.xpos[1:], data.xmat[1:]), dt=0.1)

heights = emap.layer("elevation")[0].nan_to_num()
print(f"the map is up to {float(heights.max()):.3f} m high, the scene 0.400 m; {int((heights != 0).sum())} known cells")
print("\n".join(emap.diagnose()) or "diagnose() has found nothing wrong")
if args.picture:
    x, y, _ = emap.center[0].tolist()
    panels = [Panel(title=f"{name} [m]", values=emap.layer(name)[0].numpy()) for name in ("elevation", "upper_bound")]
    save_layers(args.picture, panels, extent=(x - 3, x + 3, y - 2.4, y + 2.4))
