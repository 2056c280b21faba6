"""Maps of the worlds of MuJoCo Warp, on a CPU: `make test-mujoco` runs this in an environment of its own."""

from types import SimpleNamespace

import numpy as np
import pytest
import torch

pytest.importorskip("mujoco_warp", reason="needs mujoco-warp: make test-mujoco")

import mujoco
import mujoco_warp
import warp as wp

from tests.docs.markdown import DOCS, code_blocks, run_blocks
from tests.integrations.box_on_plane import errors
from tests.integrations.host import no_sync
from tests.integrations.test_mujoco import CFG, RAYS, SCENE, directions, heights, hill, reach_of  # noqa: F401
from torchelev.gym import MapFeed
from torchelev.integrations.mujoco import MujocoRays
from torchelev.integrations.mujoco_warp import WarpCamera, WarpRays
from torchelev.sim import mount

B = 3
PLACE = mount(pitch_deg=35.0, x=0.25, z=0.05)


@pytest.fixture(scope="module", autouse=True)
def quiet():
    wp.config.quiet = True


def put(mj_model, worlds=B):
    """Put a model and its worlds on the device."""
    data = mujoco.MjData(mj_model)
    mujoco.mj_forward(mj_model, data)
    return mujoco_warp.put_model(mj_model), mujoco_warp.put_data(mj_model, data, nworld=worlds)


@pytest.fixture
def worlds():
    """Three worlds of the scene, in which the robot stands 0, 0.1 and 0.2 m to the left."""
    mj_model = mujoco.MjModel.from_xml_string(SCENE)
    model, data = put(mj_model)
    wp.to_torch(data.qpos)[:, 1] = torch.tensor([0.0, 0.1, 0.2])
    mujoco_warp.kinematics(model, data)
    mujoco_warp.camlight(model, data)
    rays = WarpRays(mj_model, model, data, "base", RAYS, PLACE, max_distance=4.0)
    return SimpleNamespace(mj_model=mj_model, model=model, data=data, rays=rays)


def feed(worlds, **sources):
    feed = MapFeed(B, **sources, T_map_base=lambda env: worlds.rays.T_map_body(), dt=0.02, cfg=CFG)
    for step in range(3):
        feed.observe(None, torch.full((B,), step == 0), stepped=step > 0)
    return feed


def test_a_feed_of_rays_maps_each_world(worlds):
    rays = worlds.rays
    maps = feed(worlds, points=lambda env: rays.points(), T_map_sensor=lambda env: rays.T_map_sensor())
    for world in range(B):
        found = errors(maps, world)
        assert len(found) > 500 and found.quantile(0.99) < 2e-3
    assert maps.emap.center[:, 1].tolist() == pytest.approx([0.0, 0.1, 0.2], abs=0.03)


def test_a_feed_of_rendered_depth_maps_each_world(worlds):
    camera = WarpCamera(worlds.mj_model, worlds.model, worlds.data, "eye", 160, 120, max_distance=4.0)
    sources = {"depth": lambda env: camera.depth(), "intrinsics": camera.intrinsics}
    maps = feed(worlds, **sources, T_map_sensor=lambda env: camera.T_map_sensor())
    for world in range(B):
        found = errors(maps, world)
        assert len(found) > 500 and found.quantile(0.9) < 2e-3  # the leg is 0.3 m high
    depth = camera.depth()
    assert depth[depth.isfinite()].max() < 4.0 and depth.isnan().any()


def test_rays_are_those_of_mujoco(worlds):
    data = mujoco.MjData(worlds.mj_model)
    data.qpos[1] = 0.1
    mujoco.mj_forward(worlds.mj_model, data)
    expected = MujocoRays(worlds.mj_model, "base", RAYS, PLACE, max_distance=4.0).points(data)
    found = worlds.rays.points()[1]
    assert torch.equal(found.isnan(), expected.isnan())
    torch.testing.assert_close(found, expected.float(), atol=1e-4, rtol=0, equal_nan=True)


@pytest.mark.parametrize("source", ["userdata", "mesh"])
def test_rays_on_terrain_are_those_of_mujoco(heights, source, tmp_path, directions):  # noqa: F811
    """The same diagonals, by MuJoCo Warp's own triangles."""
    mj_model = hill(heights, source, tmp_path)
    rays = WarpRays(mj_model, *put(mj_model), "eye", torch.from_numpy(directions), torch.eye(4), max_distance=20.0)
    reach, expected = torch.linalg.vector_norm(rays.points()[0], dim=-1).numpy(), reach_of(mj_model, directions)
    assert np.array_equal(np.isnan(reach), np.isnan(expected)) and np.isfinite(reach).sum() > 1000
    assert np.nanmax(abs(reach - expected)) < 1e-4


def test_poses_rays_and_distances_share_their_memory(worlds):
    rays, data = worlds.rays, worlds.data
    origins, vectors, *_, distance, geom, _ = rays._args
    pairs = ((rays._origins, origins), (rays._rays, vectors), (rays._distance, distance), (rays._geom, geom))
    for tensor, array in pairs:
        assert tensor.data_ptr() == array.ptr
    assert wp.to_torch(data.xpos).data_ptr() == data.xpos.ptr


def test_a_step_does_not_wait_for_the_device(worlds):
    camera = WarpCamera(worlds.mj_model, worlds.model, worlds.data, "eye", 16, 12)
    with no_sync():
        worlds.rays.points(), worlds.rays.T_map_sensor(), camera.depth(), camera.T_map_sensor()
    with pytest.raises(AssertionError), no_sync():
        worlds.rays.points().isnan().any().item()


def test_the_page_runs():
    page = DOCS / "howto" / "mujoco.md"
    blocks = [block for block in code_blocks(page.read_text()) if "mujoco-warp" in (block.not_run or "")]
    assert blocks
    run_blocks(page, blocks)


def test_refuses_what_does_not_fit(worlds):
    args = worlds.mj_model, worlds.model, worlds.data
    with pytest.raises(ValueError, match="body: must name a body of the model, got 'dog'"):
        WarpRays(*args, "dog", RAYS, PLACE)
    with pytest.raises(ValueError, match="directions: must be unit vectors, got lengths from 2 to 2"):
        WarpRays(*args, "base", 2 * RAYS, PLACE)
    with pytest.raises(ValueError, match="camera: 'map' must be a perspective camera given by fovy"):
        WarpCamera(*args, "map", 8, 6)
