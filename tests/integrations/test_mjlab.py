"""The term for mjlab against stand-ins of its sensors; `make test-mjlab` runs it in the simulator."""

import math
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation
from torch._subclasses.fake_tensor import FakeTensorMode

from tests.integrations.simulators import (
    Env,
    build,
    ground_hits,
    look_down,
    mjlab_rays,
    mjlab_robot,
    mujoco_model,
    pinhole,
)
from torchelev import HeightScan
from torchelev.integrations import mjlab

B = 3
HEIGHTS = torch.tensor([0.3, 0.4, 0.5])
TILTED = [Rotation.from_euler("ZYX", angles) for angles in ([0.0, 0.0, 0.0], [2.0, 0.1, -0.1], [-1.0, -0.2, 0.1])]
#: MuJoCo's camera axes (x right, y up, z backward) of a camera that looks ahead
AHEAD = Rotation.from_matrix([[0.0, 0.0, -1.0], [-1.0, 0.0, 0.0], [0.0, 1.0, 0.0]])


def base():
    position = torch.tensor([[0.0, 0.0, 0.0], [20.0, -30.0, 1.0], [-7.0, 3.0, 2.0]])
    return position + HEIGHTS[:, None] * torch.tensor([0.0, 0.0, 1.0])


def ground():
    return base()[:, 2] - HEIGHTS


def with_rays(hits=None, frames=None, **settings):
    frames = base()[:, None] if frames is None else frames
    hits = ground_hits(base(), ground())[:, None] if hits is None else hits
    robot = mjlab_robot(base(), TILTED)
    return Env(robot=robot, rays=mjlab_rays(frames, hits, **settings))


def begin(env, **params):
    """Build the term and reset the environments."""
    term, observe, _ = build(mjlab.MapObservation, env, **params)
    term.reset(torch.arange(B))
    return term, observe()


def test_values_are_those_of_mjlab_s_scan():
    _, values = begin(with_rays(), sensor_name="rays")
    assert values.shape == (B, 187)
    torch.testing.assert_close(values, (HEIGHTS / 5)[:, None].expand(B, 187), atol=1e-4, rtol=0)


def test_the_manager_asks_for_the_shape_before_there_is_data():
    env = with_rays()
    env.scene["robot"].data.root_link_quat_w = torch.zeros(B, 4)  # as before the first step
    _, _, blank = build(mjlab.MapObservation, env, sensor_name="rays", standing_height=0.3)
    torch.testing.assert_close(blank, torch.full((B, 187), 0.06))


def test_misses_leave_no_trace():
    hits = ground_hits(base(), ground())[:, None].clone()
    hits[:, :, ::3] = torch.nan
    term, _ = begin(with_rays(hits), sensor_name="rays")
    elevation = term.emap.layer("elevation")
    assert (elevation - ground()[:, None, None]).abs().nan_to_num(0.0).max() < 1e-4
    points = mjlab._read_rays(with_rays(hits).scene["rays"]).points
    assert torch.equal(points[:, 0].isnan().all(-1), hits[:, 0].isnan().all(-1))


def test_each_frame_is_a_sensor_of_its_own():
    offset = torch.tensor([[[0.3, 0.0, 0.1]], [[-0.3, 0.0, 0.2]]])
    frames = base()[:, None] + offset[:, 0]
    hits = torch.stack([ground_hits(frames[:, k], ground(), half=0.5) for k in (0, 1)], 1)
    cloud = mjlab._read_rays(mjlab_rays(frames, hits))
    assert cloud.points.shape[:2] == (B, 2)
    torch.testing.assert_close(cloud.T_map_sensor[..., :3, 3], frames)
    torch.testing.assert_close(cloud.points + frames[:, :, None], hits, atol=1e-5, rtol=0)
    _, values = begin(with_rays(hits, frames), sensor_name="rays")
    torch.testing.assert_close(values[:, 93], HEIGHTS / 5, atol=1e-4, rtol=0)  # the middle one


def test_unknown_points_read_the_miss_value():
    hits = ground_hits(base(), ground(), half=0.3)[:, None]
    _, values = begin(with_rays(hits), sensor_name="rays", miss_value=1.5)
    grid = values.view(B, 11, 17)
    torch.testing.assert_close(grid[:, 5, 8], HEIGHTS / 5, atol=1e-4, rtol=0)
    assert (grid[:, :, [0, 16]] == 1.5 / 5).all()


class FootScan(mjlab.MapObservation):
    """The height of two feet over the ground below them."""

    read = HeightScan.feet(num_feet=2, rings=((0.0, 1),))


def feet():
    """A sensor with a frame for each of two feet, 0.05 and 0.1 m above the ground."""
    offset = torch.tensor([[[0.2, 0.1, 0.05], [-0.2, -0.1, 0.1]]])
    frames = torch.cat([base()[:, :2], ground()[:, None]], -1)[:, None] + offset
    return mjlab_rays(frames, torch.full((B, 2, 1, 3), torch.nan))


def test_a_scan_around_feet_reads_below_the_frames_of_a_sensor():
    env = with_rays()
    env.scene["feet"] = feet()
    params = {"sensor_name": "rays", "feet_sensor_name": "feet"}
    term, observe, blank = build(FootScan, env, **params)
    assert blank.shape == (B, 2)
    term.reset(torch.arange(B))
    torch.testing.assert_close(observe(), torch.tensor([[0.05, 0.1]]).expand(B, 2), atol=1e-3, rtol=0)
    assert term.emap is build(mjlab.MapObservation, env, sensor_name="rays")[0].emap  # terms share their maps


def test_refuses_feet_that_do_not_fit():
    env = with_rays()
    for name, words in (("feet", "must be one of rays"), ("rays", "'rays' must have a frame for each of the 2 feet")):
        with pytest.raises(ValueError, match=f"feet_sensor_name: {words}"):
            build(FootScan, env, sensor_name="rays", feet_sensor_name=name)
    with pytest.raises(TypeError, match="feet_sensor_name: must name a part of the scene"):
        build(FootScan, env, sensor_name="rays")


def depth_camera(height=24, width=32, fovy=70.0, types=("depth",), sensorsize=(0.0, 0.0)):
    """A camera of mjlab 0.1 m above each base, pitched down by 40 degrees, and the simulation that it is part of."""
    directions, _ = pinhole(fovy, height, width)
    depth, rotations = np.zeros((B, height * width)), []
    for k in range(B):
        R = TILTED[k] * Rotation.from_euler("Y", 40, degrees=True) * AHEAD
        position = base()[k].numpy() + [0, 0, 0.1]
        seen = look_down(position, R.as_matrix() @ np.diag([1, -1, -1]), directions, float(ground()[k]))
        depth[k] = np.where(seen < 5, seen, 0.0)  # mjlab: 0 where nothing is hit
        rotations.append(R.as_matrix())
    image = torch.from_numpy(depth).float().view(B, height, width, 1)
    data = SimpleNamespace(
        cam_xpos=torch.stack([torch.full((B, 3), torch.nan), base() + torch.tensor([0, 0, 0.1])], 1),
        cam_xmat=torch.stack([torch.zeros(B, 3, 3), torch.from_numpy(np.stack(rotations)).float()], 1),
    )
    model = SimpleNamespace(cam_fovy=torch.tensor([[45.0, fovy]]))
    mj_model = mujoco_model(cam_sensorsize=np.array([[0.0, 0.0], sensorsize]))
    cfg = SimpleNamespace(data_types=types, orthographic=False, enabled_geom_groups=(0,))
    sensor = SimpleNamespace(cfg=cfg, camera_idx=1, data=SimpleNamespace(depth=image))
    env = Env(robot=mjlab_robot(base(), TILTED), camera=sensor)
    env.sim = SimpleNamespace(data=data, model=model, mj_model=mj_model)
    return env


def test_depth_images_show_the_ground():
    term, _ = begin(depth_camera(), sensor_name="camera")
    elevation = term.emap.layer("elevation")
    assert (elevation.isfinite().flatten(1).sum(1) > 100).all()
    assert (elevation - ground()[:, None, None]).abs().nan_to_num(0.0).max() < 1e-3


def test_the_principal_point_lies_between_the_middle_pixels():
    K = mjlab.pinhole(torch.tensor([70.0]), 32, 24)[0]
    directions, focal = pinhole(70.0, 24, 32)
    u, v = np.meshgrid(np.arange(32), np.arange(24))
    pixels = np.stack([u.ravel(), v.ravel(), np.ones(24 * 32)], -1)
    np.testing.assert_allclose(pixels @ np.linalg.inv(K.numpy()).T, directions, atol=1e-6)
    assert float(K[0, 0]) == pytest.approx(focal)


def test_two_sensors_are_one_measurement():
    env = depth_camera()
    env.scene["rays"] = mjlab_rays(base()[:, None], ground_hits(base(), ground(), half=0.3)[:, None])
    term, _ = begin(env, sensor_name=["camera", "rays"])
    alone, _ = begin(depth_camera(), sensor_name="camera")
    assert (term.emap.layer("validity").sum((1, 2)) > alone.emap.layer("validity").sum((1, 2))).all()


def test_terms_of_two_groups_share_their_maps():
    env = with_rays()
    terms = [build(mjlab.MapObservation, env, sensor_name="rays")[0] for _ in range(2)]
    assert terms[0].emap is terms[1].emap
    assert build(mjlab.MapObservation, env, sensor_name="rays", update_every=2)[0].emap is not terms[0].emap


@pytest.mark.slow(2)
def test_a_step_does_not_wait_for_the_device(monkeypatch):
    """Fake tensors hold no data: reading a value raises. Only building the term may, to check the rays' origins."""

    class Term(mjlab.MapObservation):
        read = HeightScan.mjlab()  # it keeps its points as a fake tensor

    monkeypatch.setattr(mjlab, "_check_rays", lambda *args: None)
    with FakeTensorMode():
        pose = SimpleNamespace(root_link_pos_w=torch.zeros(B, 3), root_link_quat_w=torch.zeros(B, 4))
        rays = mjlab_rays(torch.zeros(B, 2, 3), torch.zeros(B, 2, 50, 3))
        settings = SimpleNamespace(data_types=("depth",), orthographic=False, enabled_geom_groups=(0,))
        image = SimpleNamespace(cfg=settings, camera_idx=0)
        image.data = SimpleNamespace(depth=torch.zeros(B, 6, 8, 1))
        robot = SimpleNamespace(data=pose, indexing=SimpleNamespace(root_body_id=1))
        env = Env(robot=robot, rays=rays, camera=image)
        data = SimpleNamespace(cam_xpos=torch.zeros(B, 1, 3), cam_xmat=torch.zeros(B, 1, 3, 3))
        model = SimpleNamespace(cam_fovy=torch.zeros(B, 1))
        env.sim = SimpleNamespace(data=data, model=model, mj_model=mujoco_model(cam_sensorsize=np.zeros((1, 2))))
        term, observe, _ = build(Term, env, sensor_name=["rays", "camera"])
        for ids in (torch.zeros(2, dtype=torch.int64), slice(None), None):
            term.reset(ids)
            env.common_step_counter += 1
            assert observe().shape == (B, 187)


@pytest.mark.parametrize(
    "env, params, error, words",
    [
        (with_rays, {}, TypeError, "sensor_name: must name a part of the scene, or several in a list, got None"),
        (with_rays, {"sensor_name": []}, TypeError, "sensor_name: must name a part of the scene"),
        (with_rays, {"sensor_name": "camera"}, ValueError, "sensor_name: must be one of rays, got 'camera'; correct"),
        (with_rays, {"sensor_name": "rays", "entity_name": "dog"}, ValueError,
         "entity_name: must be one of robot, got 'dog'"),
        (lambda: with_rays(starts=torch.rand(1681, 3)), {"sensor_name": "rays"}, ValueError,
         "sensor_name: the rays of 'rays' must start at one point, as those of cameras and lidars do, got starts that"),
        (lambda: with_rays(starts=torch.full((1681, 3), 0.1)), {"sensor_name": "rays"}, ValueError, "one point"),
        (lambda: with_rays(length=2.0), {"sensor_name": "rays"}, ValueError,
         "sensor_name: the rays of 'rays' must have unit vectors as directions, got lengths from 2 to 2; divide"),
        (lambda: with_rays(groups=(2, 3)), {"sensor_name": "rays"}, ValueError,
         r"sensor_name: 'rays' must see more than the robot itself, got geom groups \(2, 3\)"),
        (with_rays, {"sensor_name": "rays", "miss_value": math.inf}, ValueError,
         "miss_value: must be a finite number .m., got inf"),
        (lambda: depth_camera(types=("rgb",)), {"sensor_name": "camera"}, ValueError,
         r"sensor_name: 'camera' must measure depth, got \('rgb',\)"),
        (lambda: depth_camera(sensorsize=(0.1, 0.1)), {"sensor_name": "camera"}, ValueError, "given by fovy"),
        (lambda: Env(robot=mjlab_robot(base(), TILTED), imu=SimpleNamespace(data=0)), {"sensor_name": "imu"}, TypeError,
         "sensor_name: 'imu' must be a RayCastSensor or a CameraSensor, got SimpleNamespace"),
    ],
)  # fmt: skip
def test_refuses_what_does_not_fit(env, params, error, words):
    with pytest.raises(error, match=words):
        build(mjlab.MapObservation, env(), **params)
