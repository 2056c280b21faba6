"""What the page on MuJoCo makes of points beyond a sensor's range."""

import math

import pytest
import torch

from tests.docs.markdown import DOCS, code_blocks, run_blocks
from torchelev import depth_to_points


@pytest.fixture(scope="module")
def names():
    page = DOCS / "howto" / "mujoco.md"
    return run_blocks(page, [b for b in code_blocks(page.read_text()) if b.language == "python" and b.not_run is None])


def test_nothing_beyond_the_range_of_rays_and_rangefinder(names):
    model, data = names["model"], names["data"]
    # The base looks up by 20 degrees: at the sky, and at ground far away.
    data.qpos[3:7] = math.cos(-math.radians(10)), 0.0, math.sin(-math.radians(10)), 0.0
    names["mujoco"].mj_forward(model, data)
    reach = torch.linalg.vector_norm(names["rays"].points(data), dim=-1)
    assert reach[reach.isfinite()].max() < names["MAX_RANGE"] and reach.isnan().sum() > 100
    depth, seen = data.sensor("depth").data, names["depth"](data)
    assert (depth > names["MAX_RANGE"]).sum() > 100 and (depth < 0).sum() > 100
    assert int(seen.isfinite().sum()) == ((depth > 0) & (depth < names["MAX_RANGE"])).sum() > 1000
    points = depth_to_points(seen[None], names["pinhole"](torch.tensor(58.0), names["width"], names["height"]))[0]
    T = names["T_map_sensor"](data)
    z = (points.double() @ T[:3, :3].T + T[:3, 3])[seen.flatten().isfinite(), 2]
    assert z.min() > -1e-6 and z.max() < 0.2 + 1e-6 and (z.abs() < 1e-6).sum() > 1000  # the floor and the box
