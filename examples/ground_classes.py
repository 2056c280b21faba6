"""What the ground is made of: a camera's colours, classified and painted onto the map.

    python examples/ground_classes.py --picture classes.png

A camera is carried past stone and mud on grass. A classifier says which of them each pixel may show, and the map
gathers its probabilities. Put your network in the place of `classify`. Needs OpenGL and `pip install mujoco`.
"""

import argparse
import math
import os

os.environ.setdefault("MUJOCO_GL", "egl")  # render without a screen; read when mujoco is imported
import mujoco
import torch

from torchelev import ChannelConfig, ElevationMap, ElevationMapConfig, GridConfig, depth_to_points
from torchelev.frames import transform_matrix
from torchelev.integrations.mujoco import MujocoCamera
from torchelev.viz.plot import Panel, save_layers

WIDTH, HEIGHT = 320, 240  # [pixels]
COLORS = {"grass": (0.25, 0.5, 0.15), "stone": (0.55, 0.55, 0.6), "mud": (0.45, 0.28, 0.12)}
TILES = [(0.8 + 0.6 * k, 0.5 * math.sin(k), 0.25, 0.25, "stone") for k in range(6)] + [(2.2, -1.2, 0.9, 0.4, "mud")]
GEOMS = "".join(
    f'<geom type="box" size="{a} {b} .01" pos="{x} {y} .01" rgba="{" ".join(map(str, COLORS[kind]))} 1"/>'
    for x, y, a, b, kind in TILES
)
SCENE = f"""<mujoco><visual><headlight ambient=".5 .5 .5"/></visual><worldbody><light pos="2 3 4" dir="-.2 -.5 -1"/>
  <geom type="plane" size="9 9 .1" rgba="{" ".join(map(str, COLORS["grass"]))} 1"/>{GEOMS}
  <geom type="box" size=".1 .3 .25" pos="1.6 .9 .25" rgba=".8 .1 .1 1"/>
  <body name="robot" mocap="true"><camera name="eye" xyaxes="0 -1 0 .5 0 .866" fovy="58"/></body>
</worldbody></mujoco>"""


def classify(rgb):
    """Return the probabilities (3, h, w) of the classes of an image (h, w, 3), by chroma: shadows are no mud."""
    means = torch.tensor(list(COLORS.values()))
    chroma, means = (c / c.sum(-1, keepdim=True).clamp(min=0.1) for c in (rgb.float(), means))
    distance = (chroma[:, :, None] - means).square().sum(-1)
    return torch.softmax(-distance / (2 * 0.06**2), -1).permute(2, 0, 1)


def truth(xy):
    """Return the class of places (..., 2) [m]."""
    kinds = torch.zeros(xy.shape[:-1], dtype=torch.int64)
    for *center, a, b, kind in TILES:
        kinds[((xy - torch.tensor(center)).abs() < torch.tensor([a, b])).all(-1)] = list(COLORS).index(kind)
    return kinds


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--steps", type=int, default=30)
    parser.add_argument("--picture", help="file to write")
    args = parser.parse_args()

    model = mujoco.MjModel.from_xml_string(SCENE)
    data, camera = mujoco.MjData(model), MujocoCamera(model, "eye", WIDTH, HEIGHT, max_distance=5.0)
    renderer = mujoco.Renderer(model, HEIGHT, WIDTH)
    channels = {"terrain": ChannelConfig(kind="class", names=tuple(COLORS))}
    emap = ElevationMap(ElevationMapConfig(grid=GridConfig(resolution=0.05, length_x=6, length_y=5), channels=channels))
    for step in range(args.steps):
        data.mocap_pos[0] = (2.0 * step / args.steps, 0.3 * math.sin(step / 6), 0.8)
        mujoco.mj_forward(model, data)
        renderer.update_scene(data, "eye")
        probabilities = classify(torch.from_numpy(renderer.render().copy()))[None]
        T_map_camera = camera.T_map_sensor(data)[None]
        points = depth_to_points(camera.depth(data)[None], camera.intrinsics)
        emap.update(points, T_map_camera, transform_matrix(data.xpos[1:], data.xmat[1:]), dt=0.1)
        emap.paint(probabilities, camera.intrinsics, T_map_camera, "terrain")
    seen = emap.layer("terrain.mud")[0].isfinite() & (emap.layer("elevation")[0] < 0.1)  # but not the red block
    best = emap.layer("terrain")[0].argmax(0)
    right = (best == truth(emap.cell_centers()[0]))[seen].float().mean()
    print(f"{int(seen.sum())} cells of ground were painted; the most probable class is right for {100 * right:.0f} %")
    if args.picture:
        x, y, _ = emap.center[0].tolist()
        names = ("elevation", *channels["terrain"].components("terrain"))
        panels = [Panel(title=name, values=emap.layer(name)[0].numpy()) for name in names]
        save_layers(args.picture, panels, extent=(x - 3, x + 3, y - 2.5, y + 2.5), title="The camera moves ahead")
