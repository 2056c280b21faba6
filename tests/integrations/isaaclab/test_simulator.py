"""The term in Isaac Lab itself, on a CPU: `make test-isaaclab` runs this in an environment of its own."""

import copy
import math
import os
import re
import subprocess
import sys
from pathlib import Path

import pytest
import torch

pytest.importorskip("isaaclab", reason="needs Isaac Lab: make test-isaaclab")

from isaaclab.managers import ObservationTermCfg, SceneEntityCfg
from isaaclab.utils import to_dict
from isaaclab.utils.math import matrix_from_quat, quat_apply

from benchmarks.quality.isaac_lab import task
from benchmarks.quality.mjlab_task import compare
from tests.docs.markdown import DOCS, code_blocks
from tests.integrations.examples import run_example
from tests.integrations.host import no_sync
from torchelev import ElevationMap, HeightScan
from torchelev.integrations.isaac_lab import MapObservation, to_tensor

ROOT = Path(__file__).parents[3]
EYE = torch.tensor([0.22, 0.0, 0.08])  # of the cameras on the base


@pytest.fixture(scope="module")
def walked(env, terms):
    return task.walk(env, terms, steps=200)


def step(env):
    return env.step(torch.zeros(env.num_envs, env.action_manager.total_action_dim))


def time_out(env, ids):
    """Let episodes end within a step, and return the observations that begin the next ones."""
    env.episode_length_buf[ids] = env.max_episode_length
    observed, _, _, ended, _ = step(env)
    assert ended.nonzero()[:, 0].tolist() == ids
    return observed


def base(env):
    data = env.scene["robot"].data
    return data.root_link_pos_w.torch, data.root_link_quat_w.torch


def known(term):
    return term.emap.layer("validity").sum((1, 2))


# --- values ---


@pytest.mark.parametrize("name, share", [("camera", 0.15), ("lidar", 0.9), ("both", 0.9), ("rendered", 0.15)])
def test_the_scan_is_isaac_lab_s_own_on_visible_ground(walked, name, share):
    found = compare(walked[name])
    print(name, found)
    assert found["valid"] > share and found["all"]["points"] > 20_000
    assert found["all"]["p50"] < 0.001 and found["all"]["p90"] < 0.02
    assert found["level"]["p99"] < 0.03


def test_an_order_or_sign_that_differs_would_be_seen(walked):
    error, grid = compare(walked["lidar"])["all"]["p90"], walked["lidar"]["ours"].unflatten(-1, (11, 17))
    for wrong in (grid.flip(-1), grid.flip(-2), -grid, grid.flatten(-2).unflatten(-1, (17, 11)).mT):
        assert compare({**walked["lidar"], "ours": wrong.flatten(-2)})["all"]["p90"] > 5 * error


def test_the_policy_reads_the_scan(env, terms):
    observed = step(env)[0]
    scan = HeightScan.isaac_lab(standing_height=task.STANDING_HEIGHT)
    for name, values in {"camera": observed["policy"][:, -187:], "lidar": observed["maps"]["lidar"]}.items():
        ours, _ = scan(terms[name].emap, terms[name].maps.source.read_base(env))
        torch.testing.assert_close(values, ours)


def test_a_step_later_the_observation_is_as_it_was(env):
    before = step(env)[0]["policy"]
    copied = before.clone()
    step(env)
    torch.testing.assert_close(before, copied, rtol=0, atol=0)


def test_two_sensors_are_one_measurement(env, terms):
    env.reset()
    camera, lidar, both = (terms[name].emap.layer("validity").bool() for name in ("camera", "lidar", "both"))
    assert (camera & ~lidar).any() and (lidar & ~camera).any()
    # The same cells: a cell that one sensor just touches may be cleared by the other.
    assert (both == camera | lidar).float().mean() > 0.99


# --- misses ---


def test_a_camera_sees_no_farther_than_it_is_told(env):
    """With the default of depth_clipping_behavior it would; what is farther is a miss, 0."""
    depth = env.scene["camera"].data.output["distance_to_image_plane"].torch
    assert depth.min() >= 0 and 0.2 < depth.max() <= 4.0


def test_misses_do_not_become_walls(env, terms, walked):
    hits = env.scene["lidar"].data.ray_hits_w.torch
    missed = ~hits.isfinite().all(-1)
    assert hits[missed].isinf().all() and missed.float().mean() > 0.1
    ours, ideal = walked["lidar"]["ours"], walked["lidar"]["ideal"]
    assert ideal.min() > -0.9  # no wall is there
    assert ours.min() > -0.9


@pytest.mark.parametrize("name", ["camera", "rendered"])
def test_an_image_of_the_sky_has_no_points(env, terms, name):
    """Both cameras report a miss as 0."""
    place, _ = base(env)
    up = torch.tensor([[0.0, -0.5, 0.0, 0.866]]).expand(4, 4)  # by 60 degrees, 20 degrees over the horizon
    env.scene["robot"].write_root_pose_to_sim_index(root_pose=torch.cat([place, up], -1))
    env.sim.forward()
    sensor = env.scene[name]
    sensor.update(env.step_dt, force_recompute=True)
    missed = sensor.data.output["distance_to_image_plane"].torch.flatten(1) == 0
    assert missed.float().mean() > 0.5
    points, _ = terms[name].maps.source.read_cloud(env)
    assert (points[:, 0].isnan().all(-1) == missed).all()


# --- resets ---


def test_a_reset_forgets_the_maps_of_the_environments_that_began(env, terms):
    step(env)
    before = {name: term.emap.layer("elevation") for name, term in terms.items() if name != "slow"}
    env.reset(env_ids=torch.tensor([1, 3]))
    for name, elevation in before.items():
        again = terms[name].emap.layer("elevation")
        torch.testing.assert_close(again[[0, 2]], elevation[[0, 2]], equal_nan=True, rtol=0, atol=0)
        assert (known(terms[name])[[1, 3]] > 0).all()
        assert all(not torch.equal(again[k].isnan(), elevation[k].isnan()) for k in (1, 3))


@pytest.mark.parametrize("name", ["camera", "lidar", "rendered"])
def test_an_episode_begins_with_what_is_seen_at_the_new_place(env, terms, name):
    for _ in range(5):
        step(env)
    old = base(env)[0].clone()
    time_out(env, [0, 2])
    place, quat = base(env)
    assert (place - old)[[0, 2], :2].norm(dim=-1).max() > 0.05
    sensor = env.scene[name].data.pos_w.torch
    offset = torch.zeros(3) if name == "lidar" else EYE  # a ray caster's pose is that of its prim
    torch.testing.assert_close(sensor, place + quat_apply(quat, offset.expand(4, 3)), atol=1e-4, rtol=0)
    # The map holds one measurement from there.
    source = terms[name].maps.source
    fresh = ElevationMap(terms[name].map_cfg, num_envs=4)
    fresh.update(*source.read_cloud(env), source.read_base(env), dt=0.0)
    assert (known(terms[name])[[0, 2]] > 50).all()
    found, expected = terms[name].emap.layer("elevation"), fresh.layer("elevation")
    torch.testing.assert_close(found[[0, 2]], expected[[0, 2]], equal_nan=True, atol=1e-5, rtol=0)


def test_isaac_lab_alone_would_show_a_camera_the_old_place(env, monkeypatch):
    """Why the term moves the links itself: the first image of an episode would be of the place that the robot left."""
    monkeypatch.setattr(env.sim, "forward", lambda: None)
    time_out(env, [1])
    place, quat = base(env)
    expected = place + quat_apply(quat, EYE.expand(4, 3))
    wrong = (env.scene["camera"].data.pos_w.torch - expected).norm(dim=-1)
    assert wrong[1] > 0.05 and (wrong[[0, 2, 3]] < 1e-4).all()


# --- slow sensors ---


def test_a_slow_camera_is_fused_once_per_image(env, terms, monkeypatch):
    env.reset()
    source, frames = terms["slow"].maps.source, []
    read = type(source).read_cloud

    def note(self, env):
        cloud = read(self, env)
        if self is source:
            frames.append(env.scene["slow"].frame.clone())
        return cloud

    monkeypatch.setattr(type(source), "read_cloud", note)
    for _ in range(10):
        step(env)
    assert len(frames) == 5
    assert (torch.stack(frames).diff(dim=0) == 1).all()


def test_a_map_of_a_slow_camera_is_right(walked):
    found = compare(walked["slow"])
    print("slow", found)
    assert found["valid"] > 0.1 and found["all"]["p50"] < 0.002 and found["all"]["p90"] < 0.03


# --- data ---


def test_arrays_are_read_without_copies(env):
    robot, camera, lidar = (env.scene[name].data for name in ("robot", "camera", "lidar"))
    depth = camera.output["distance_to_image_plane"]
    for array in (robot.root_link_quat_w, camera.pos_w, camera.quat_w_ros, depth, lidar.ray_hits_w):
        assert type(array).__name__ == "ProxyArray"
        assert to_tensor(array).data_ptr() == array.warp.ptr


def test_quaternions_are_x_y_z_w(env, terms):
    _, quat = base(env)
    R = terms["camera"].maps.source.read_base(env)[:, :3, :3]
    torch.testing.assert_close(R, matrix_from_quat(quat), atol=1e-5, rtol=0)
    data = env.scene["camera"].data
    forward = quat_apply(data.quat_w_ros.torch, torch.tensor([[0.0, 0.0, 1.0]]).expand(4, 3))  # z of optical axes
    ahead = quat_apply(data.quat_w_world.torch, torch.tensor([[1.0, 0.0, 0.0]]).expand(4, 3))
    torch.testing.assert_close(forward, ahead, atol=1e-5, rtol=0)


def test_a_step_does_not_wait_for_the_device(env, terms):
    step(env)
    with no_sync():
        with pytest.raises(AssertionError, match="waits for the device"):
            torch.ones(1).item()
        for name in ("camera", "both", "rendered"):
            term = terms[name]
            term.reset(torch.tensor([0, 2], dtype=torch.int32))
            assert term(env, sensor_cfg=None).shape == (4, 187)
            env.common_step_counter += 2
            assert term(env, sensor_cfg=None).shape == (4, 187)


# --- refusals ---


@pytest.mark.parametrize(
    "params, words",
    [
        ({"sensor_cfg": "eye"}, "sensor_cfg: must be one of .*camera.*, got 'eye'"),
        ({"sensor_cfg": "height_scanner"}, "the rays of 'height_scanner' must start at one point"),
        ({"sensor_cfg": "contact_forces"}, "'contact_forces' must be a RayCaster or a camera, got ContactSensor"),
        ({"sensor_cfg": "slow"}, "'slow' must measure at least every 0.02 s"),
        ({"sensor_cfg": "inside"}, "'inside' must see more than the robot"),
        ({"sensor_cfg": "camera", "asset_cfg": "dog"}, "asset_cfg: must be one of .*robot.*, got 'dog'"),
    ],
)
def test_refuses_what_does_not_fit(env, params, words):
    with pytest.raises((ValueError, TypeError), match=words):
        MapObservation(ObservationTermCfg(func=MapObservation, params=params), env)


def test_refuses_another_order_of_quaternions(env):
    class Other(MapObservation):
        quaternions = "wxyz"

    with pytest.raises(ValueError, match="quaternions: must be the order in which the robot's data give them"):
        Other(ObservationTermCfg(func=Other, params={"sensor_cfg": SceneEntityCfg("camera")}), env)


@pytest.mark.parametrize(
    "name, value, words",
    [
        ("update_latest_camera_pose", False, "must report its current pose"),
        ("renderer_cfg", "max", "must not report misses as its maximum distance"),
    ],
)
def test_refuses_a_rendered_camera_that_misleads(env, monkeypatch, name, value, words):
    cfg = env.scene["rendered"].cfg
    if name == "renderer_cfg":
        renderer = copy.copy(cfg.renderer_cfg)
        renderer.depth_clipping_behavior, value = value, renderer
    monkeypatch.setattr(cfg, name, value)
    with pytest.raises(ValueError, match=words):
        MapObservation(ObservationTermCfg(func=MapObservation, params={"sensor_cfg": "rendered"}), env)


def test_isaac_lab_s_own_script_trains_with_the_term(tmp_path):
    """Two iterations of PPO: the config becomes a dictionary, YAML and a config again, and rsl_rl steps the term."""
    script = ROOT / "tests/integrations/isaaclab/train.py"
    env = {**os.environ, "PYTHONPATH": str(ROOT)}
    done = subprocess.run([sys.executable, script], cwd=tmp_path, env=env, capture_output=True, text=True)
    assert done.returncode == 0, done.stdout + done.stderr
    losses = [float(value) for value in re.findall(r"Mean value loss: (\S+)", done.stdout)]
    assert len(losses) == 2 and all(math.isfinite(value) for value in losses)
    (written,) = tmp_path.glob("logs/**/env.yaml")
    assert "torchelev.integrations.isaac_lab:MapObservation" in written.read_text()


def test_the_manager_can_write_down_the_term(env):
    assert "height_scan" in env.observation_manager.serialize()["policy"]


# --- the page ---


def test_the_config_of_the_page_is_this_one():
    block = next(
        block for block in code_blocks((DOCS / "howto/isaac_lab.md").read_text()) if block.language == "python"
    )
    names = {"__name__": __name__}
    exec(block.code, names)
    given, ours = names["MapEnvCfg"](), task.MapEnvCfg()
    assert to_dict(given.scene.camera) == to_dict(ours.scene.camera)
    terms = [to_dict(cfg.observations.policy.height_scan) for cfg in (given, ours)]
    for term in terms:
        del term["params"]["standing_height"]
    assert terms[0] == terms[1]


def test_the_example_runs(tmp_path):
    assert "observation (8, 187)" in run_example("isaac_lab_term", tmp_path)
