"""Maps of Genesis from points as it returns them; tests/integrations/test_genesis_simulator.py runs Genesis itself."""

import math
from types import SimpleNamespace

import torch

from torchelev import ElevationMapConfig, GridConfig
from torchelev.frames import transform
from torchelev.integrations.genesis import GenesisMaps


def test_a_tilted_sensor_in_genesis_sees_a_flat_floor():
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

    link = SimpleNamespace(get_pos=lambda: position, get_quat=lambda: quat)
    options = SimpleNamespace(return_points=True, return_world_frame=False, no_hit_value=max_range, pos_offset=offset)
    cloud = SimpleNamespace(points=points.view(1, 40, 60, 3), distances=distance.view(1, 40, 60))
    sensor = SimpleNamespace(_options=options, _link=link, read=lambda: cloud)
    maps = GenesisMaps(link, [sensor], ElevationMapConfig(grid=GridConfig(resolution=0.05, length_x=6.0, length_y=4.0)))
    maps.update(0.1)
    assert int(maps.emap.statistics.rejected_invalid) == int((distance == max_range).sum()) > 500
    elevation = maps.emap.layer("elevation")
    assert elevation.isfinite().sum() > 300 and elevation[elevation.isfinite()].abs().max() < 1e-3
    maps.reset(torch.tensor([0]))
    assert maps.emap.layer("elevation").isnan().all()
