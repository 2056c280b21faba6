"""What the page on MuJoCo and Genesis makes of points beyond a sensor's range, and of a tilted sensor."""

import math

import numpy as np
import pytest
import torch

from tests.docs.markdown import DOCS, code_blocks, run_blocks
from torchelev import ElevationMap, ElevationMapConfig, GridConfig
from torchelev.frames import transform


@pytest.fixture(scope="module")
def names():
    page = DOCS / "howto" / "mujoco.md"
    return run_blocks(page, [b for b in code_blocks(page.read_text()) if b.language == "python" and b.not_run is None])


def test_nothing_beyond_the_range_of_rays_and_rangefinder(names):
    model, data = names["model"], names["data"]
    # The base looks up by 20 degrees: at the sky, and at ground far away.
    data.qpos[3:7] = math.cos(-math.radians(10)), 0.0, math.sin(-math.radians(10)), 0.0
    names["mujoco"].mj_forward(model, data)
    reach = np.linalg.norm(names["observe"](model, data)[0], axis=1)
    assert np.nanmax(reach) < names["MAX_RANGE"] and np.isnan(reach).sum() > 100
    depth, seen = data.sensor("depth").data, names["measure_depth"](data)[0][0].double()
    assert (depth > names["MAX_RANGE"]).sum() > 100 and (depth < 0).sum() > 100
    hit = seen.isfinite().all(-1)
    assert int(hit.sum()) == ((depth > 0) & (depth < names["MAX_RANGE"])).sum() > 1000
    world = seen[hit] @ torch.from_numpy(data.camera("depth").xmat.reshape(3, 3)).T
    z = world[:, 2] + data.camera("depth").xpos[2]
    assert z.min() > -1e-6 and z.max() < 0.2 + 1e-6 and (z.abs() < 1e-6).sum() > 1000  # the floor and the box


def test_a_tilted_sensor_in_genesis_sees_a_flat_floor(names):
    """Points as Genesis returns them: along rays that its offset has turned into the axes of the link."""
    tilt, offset, max_range = math.radians(30), (0.3, 0.0, 0.1), 4.0
    quat = torch.tensor([[math.cos(0.1), 0.0, math.sin(0.1), 0.0]])  # the robot itself looks down by 0.2 rad
    position = torch.tensor([[2.0, -1.0, 0.6]])
    angle = torch.linspace(-0.9, 0.5, 40)
    pattern = torch.stack(torch.meshgrid(angle, torch.linspace(-0.8, 0.8, 60), indexing="ij"), -1).view(-1, 2)
    down, left = pattern.unbind(-1)
    rays = torch.stack([down.cos() * left.cos(), down.cos() * left.sin(), -down.sin()], -1)
    turn = transform(torch.zeros(1, 3), torch.tensor([[math.cos(tilt / 2), 0.0, math.sin(tilt / 2), 0.0]]))[0, :3, :3]
    rays = rays @ turn.T
    T_map_link = transform(position, quat)[0]
    origin = T_map_link[:3, :3] @ torch.tensor(offset) + T_map_link[:3, 3]
    distance = origin[2] / -(rays @ T_map_link[2, :3])
    distance = torch.where((distance > 0) & (distance < max_range), distance, max_range)
    points = torch.where((distance < max_range)[:, None], distance[:, None] * rays, 0.0)

    cloud, T_map_sensor, T_map_base = names["read_genesis"](
        points.view(1, 40, 60, 3), distance.view(1, 40, 60), position, quat, offset, max_range
    )
    assert int(cloud.isfinite().all(-1).sum()) == int((distance < max_range).sum()) > 500
    emap = ElevationMap(ElevationMapConfig(grid=GridConfig(resolution=0.05, length_x=6.0, length_y=4.0)))
    emap.update(cloud, T_map_sensor, T_map_base, dt=0.1)
    elevation = emap.layer("elevation")
    assert elevation.isfinite().sum() > 300 and elevation[elevation.isfinite()].abs().max() < 1e-3
