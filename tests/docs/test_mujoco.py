"""What the page on MuJoCo makes of points beyond a sensor's range."""

import math

import numpy as np
import pytest
import torch

from tests.docs.markdown import DOCS, code_blocks, run_blocks


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
