"""The term for Isaac Lab against stand-ins of its sensors, in the conventions of 2.x and of 3.0."""

from types import SimpleNamespace

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation
from torch._subclasses.fake_tensor import FakeTensorMode

from tests.integrations.simulators import Env, build, ground_hits, look_down, pinhole, quat_wxyz
from tests.processes import run_python
from torchelev import HeightScan
from torchelev.integrations import isaac_lab

B = 3
HEIGHTS = torch.tensor([0.4, 0.5, 0.6])
BASE = torch.tensor([[0.0, 0.0, 0.4], [20.0, -30.0, 1.5], [-7.0, 3.0, 2.6]])
GROUND = BASE[:, 2] - HEIGHTS
TILTED = [Rotation.from_euler("ZYX", angles) for angles in ([0.0, 0.0, 0.0], [2.0, 0.1, -0.1], [-1.0, -0.2, 0.1])]
#: optical axes (x right, y down, z forward) of a camera that looks ahead
OPTICAL = Rotation.from_matrix([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])
HEIGHT, WIDTH, FOVY = 24, 32, 70.0


class Array:
    """Isaac Lab 3's `ProxyArray`: a tensor behind `.torch`."""

    def __init__(self, tensor):
        self.torch = tensor


class Version:
    """How a version gives tensors and quaternions."""

    def __init__(self, number):
        self.array = Array if number == 3 else lambda tensor: tensor
        self.order = (lambda quat: quat.roll(-1, -1)) if number == 3 else (lambda quat: quat)

    def quat(self, rotations):
        return self.array(self.order(quat_wxyz(rotations)))

    def robot(self):
        data = SimpleNamespace(root_link_pos_w=self.array(BASE), root_link_quat_w=self.quat(TILTED))
        return SimpleNamespace(data=data)

    def camera(self, name="distance_to_image_plane", miss=torch.inf, **cfg):
        """A RayCasterCamera 0.1 m above each base, pitched down by 40 degrees."""
        directions, focal = pinhole(FOVY, HEIGHT, WIDTH)
        depth, rotations, position = [], [], BASE + torch.tensor([0.0, 0.0, 0.1])
        for k in range(B):
            R = TILTED[k] * Rotation.from_euler("Y", 40, degrees=True) * OPTICAL
            along_z = look_down(position[k].numpy(), R.as_matrix(), directions, float(GROUND[k]))
            along = np.linalg.norm(directions, axis=-1) if name == "distance_to_camera" else 1.0
            depth.append(np.where(along_z < 5, along_z * along, np.inf))
            rotations.append(R)
        image = torch.from_numpy(np.stack(depth)).float().view(B, HEIGHT, WIDTH, 1)
        image = torch.where(image.isinf(), miss, image)
        K = torch.tensor([[focal, 0, WIDTH / 2], [0, focal, HEIGHT / 2], [0, 0, 1]]).repeat(B, 1, 1)
        data = SimpleNamespace(pos_w=self.array(position), quat_w_ros=self.quat(rotations))
        data.output, data.intrinsic_matrices = {name: self.array(image)}, self.array(K)
        return SimpleNamespace(cfg=SimpleNamespace(**{"data_types": [name], "update_period": 0.0} | cfg), data=data)

    def caster(self, start=(0.0, 0.0, 0.0), hits=None, **cfg):
        """A RayCaster on each base whose rays start at `start` [m], turned with the sensor as `ray_alignment` says."""
        hits = ground_hits(BASE, GROUND) if hits is None else hits
        data = SimpleNamespace(pos_w=self.array(BASE), quat_w=self.quat(TILTED), ray_hits_w=self.array(hits))
        starts = self.array(torch.tensor(start).expand(*hits.shape))
        cfg = SimpleNamespace(**{"update_period": 0.0, "ray_alignment": "base"} | cfg)
        return SimpleNamespace(cfg=cfg, data=data, ray_starts=starts)


@pytest.fixture(params=[2, 3])
def version(request):
    return Version(request.param)


def begin(version, sensor, **params):
    """Build the term with one sensor and reset the environments; return it and its values."""
    env = Env(robot=version.robot(), sensor=sensor)
    term, observe, _ = build(isaac_lab.MapObservation, env, sensor_cfg=SimpleNamespace(name="sensor"), **params)
    term.reset([0, 1, 2])
    return term, observe()


def error_of(term):
    return (term.emap.layer("elevation") - GROUND[:, None, None]).abs()


def test_values_are_those_of_isaac_lab_s_scan(version):
    _, values = begin(version, version.caster())
    torch.testing.assert_close(values, (HEIGHTS - 0.5)[:, None].expand(B, 187), atol=1e-4, rtol=0)


@pytest.mark.parametrize("name", ["distance_to_image_plane", "distance_to_camera", "depth"])
def test_depth_images_show_the_ground(version, name):
    term, _ = begin(version, version.camera(name))
    assert (error_of(term).isfinite().flatten(1).sum(1) > 100).all()
    assert error_of(term).nan_to_num(0.0).max() < 1e-3


@pytest.mark.parametrize("miss", [torch.inf, torch.nan, 0.0])
def test_misses_of_a_camera_leave_no_trace(version, miss):
    term, _ = begin(version, version.camera(miss=miss))
    assert error_of(term).nan_to_num(0.0).max() < 1e-3


def test_misses_of_a_caster_leave_no_trace(version):
    hits = ground_hits(BASE, GROUND).clone()
    hits[:, ::3] = torch.inf
    term, values = begin(version, version.caster(hits=hits))
    assert error_of(term).nan_to_num(0.0).max() < 1e-4
    assert (values > -0.2).all()  # in Isaac Lab they would read -1


def test_reading_intrinsics_does_not_change_them(version):
    camera = version.camera()
    before = isaac_lab.to_tensor(camera.data.intrinsic_matrices).clone()
    begin(version, camera)
    torch.testing.assert_close(isaac_lab.to_tensor(camera.data.intrinsic_matrices), before)


@pytest.mark.parametrize("alignment", ["base", "yaw", "world"])
def test_the_offset_of_a_caster_turns_as_its_rays_do(version, alignment):
    start = np.array([0.3, -0.2, 0.5])
    source = isaac_lab.IsaacLabSource(("sensor",), "robot", "xyzw" if version.array is Array else "wxyz")
    cloud = source._read_rays(version.caster(tuple(start.tolist()), ray_alignment=alignment))
    for k in range(B):
        yaw = Rotation.from_euler("Z", TILTED[k].as_euler("ZYX")[0])
        turn = {"base": TILTED[k], "yaw": yaw, "world": Rotation.identity()}[alignment]
        np.testing.assert_allclose(cloud.T_map_sensor[k, 0, :3, 3], BASE[k].numpy() + turn.apply(start), atol=1e-5)


def test_an_older_setting_of_the_alignment_counts_too(version):
    caster = version.caster((0.3, 0.0, 0.0), attach_yaw_only=True)
    del caster.cfg.ray_alignment
    T = isaac_lab.IsaacLabSource((), "", "xyzw" if version.array is Array else "wxyz")._read_rays(caster).T_map_sensor
    torch.testing.assert_close(T[:, 0, 2, 3], BASE[:, 2])


def test_an_order_that_is_given_is_used():
    class Other(isaac_lab.MapObservation):
        quaternions = "xyzw"

    version = Version(2)
    version.order = Version(3).order  # tensors, as in 2.x, but x y z w
    env = Env(robot=version.robot(), sensor=version.camera())
    term, observe, _ = build(Other, env, sensor_cfg="sensor")
    term.reset()
    observe()
    assert (error_of(term).isfinite().flatten(1).sum(1) > 100).all()
    assert error_of(term).nan_to_num(0.0).max() < 1e-3


def test_a_slow_sensor_is_read_as_often_as_it_measures(version):
    camera = version.camera(update_period=0.1)
    with pytest.raises(ValueError, match="'sensor' must measure at least every 0.02 s"):
        begin(version, camera)
    begin(version, camera, update_every=5)


@pytest.mark.slow(2)
def test_a_step_does_not_wait_for_the_device(monkeypatch):
    """Fake tensors hold no data: reading a value raises. Only building the term may, to check the rays' origins."""

    class Term(isaac_lab.MapObservation):
        read = HeightScan.isaac_lab()  # it keeps its points as a fake tensor

    monkeypatch.setattr(isaac_lab, "require_one_origin", lambda *args: None)
    with FakeTensorMode():
        place, quat = Array(torch.zeros(B, 3)), Array(torch.zeros(B, 4))
        robot = SimpleNamespace(data=SimpleNamespace(root_link_pos_w=place, root_link_quat_w=quat))
        image = {"depth": Array(torch.zeros(B, 6, 8, 1))}
        data = SimpleNamespace(pos_w=place, quat_w_ros=quat, output=image, intrinsic_matrices=torch.zeros(B, 3, 3))
        camera = SimpleNamespace(cfg=SimpleNamespace(data_types=["depth"], update_period=0.0), data=data)
        hits = Array(torch.zeros(B, 50, 3))
        cfg = SimpleNamespace(update_period=0.0, ray_alignment="yaw")
        caster = SimpleNamespace(cfg=cfg, data=SimpleNamespace(pos_w=place, quat_w=quat, ray_hits_w=hits))
        caster.ray_starts = hits
        env = Env(robot=robot, camera=camera, caster=caster)
        term, observe, _ = build(Term, env, sensor_cfg=["camera", "caster"])
        for ids in (torch.zeros(2, dtype=torch.int64), None):
            term.reset(ids)
            env.common_step_counter += 1
            assert observe().shape == (B, 187)


@pytest.mark.parametrize(
    "sensor, params, error, words",
    [
        (Version(2).caster(), {"sensor_cfg": None}, TypeError, "sensor_cfg: must name a part of the scene"),
        (Version(2).caster(), {"sensor_cfg": "camera"}, ValueError, "sensor_cfg: must be one of sensor, got 'camera'"),
        (Version(2).caster(), {"asset_cfg": "dog"}, ValueError, "asset_cfg: must be one of robot, sensor, got 'dog'"),
        (Version(2).caster(), {"update_every": "two"}, ValueError, "update_every: must be a positive int"),
        (SimpleNamespace(cfg=SimpleNamespace(update_period=0.0)), {}, TypeError,
         "'sensor' must be a RayCaster or a camera, got SimpleNamespace"),
        (Version(2).camera("rgb"), {}, ValueError, r"'sensor' must have one of .*, got \['rgb'\]"),
        (Version(2).camera(depth_clipping_behavior="max"), {}, ValueError, "must not report misses as its maximum"),
        (Version(3).camera(renderer_cfg=SimpleNamespace(depth_clipping_behavior="max")), {}, ValueError,
         "must not report misses as its maximum"),
        (Version(2).camera(update_latest_camera_pose=False), {}, ValueError, "must report its current pose"),
    ],
)  # fmt: skip
def test_refuses_what_does_not_fit(sensor, params, error, words):
    with pytest.raises(error, match=words):
        build(
            isaac_lab.MapObservation, Env(robot=Version(2).robot(), sensor=sensor), **{"sensor_cfg": "sensor"} | params
        )


def test_refuses_an_environment_that_does_not_count_its_steps(version):
    """As Isaac Lab's ManagerBasedEnv, which is not for reinforcement learning."""
    env = Env(robot=version.robot(), sensor=version.camera())
    del env.common_step_counter
    with pytest.raises(TypeError, match="env: must count its steps .*, got Env; use ManagerBasedRLEnv"):
        build(isaac_lab.MapObservation, env, sensor_cfg="sensor")


def test_an_episode_begins_after_the_links_are_at_the_new_place(version):
    """Newton moves them with the next step; a camera that is read before would see the old place."""
    env = Env(robot=version.robot(), sensor=version.camera())
    forwarded = []
    env.sim.forward = lambda: forwarded.append(env.common_step_counter)
    term, observe, _ = build(isaac_lab.MapObservation, env, sensor_cfg="sensor")
    observe()
    assert forwarded == []
    term.reset(torch.tensor([1]))
    assert forwarded == [0]


@pytest.mark.parametrize("order, wrong", [("wxyz", "xyzw"), ("xyzw", "wxyz")])
@pytest.mark.parametrize("poses", [[Rotation.identity()] * B, TILTED])
def test_refuses_an_order_that_contradicts_heading_and_gravity(order, wrong, poses):
    version = Version(2 if order == "wxyz" else 3)
    robot = version.robot()
    robot.data.root_link_quat_w = version.quat(poses)
    R = torch.from_numpy(np.stack([pose.as_matrix() for pose in poses])).float()
    robot.data.heading_w = version.array(torch.atan2(R[:, 1, 0], R[:, 0, 0]))
    robot.data.projected_gravity_b = version.array(-R[:, 2])
    robot.data.GRAVITY_VEC_W = version.array(torch.tensor([[0.0, 0.0, -9.81]]).expand(B, 3))
    env = Env(robot=robot, sensor=version.caster())
    build(type("Right", (isaac_lab.MapObservation,), {"quaternions": order}), env, sensor_cfg="sensor")
    with pytest.raises(ValueError, match=f"quaternions: must be the order .*, got '{wrong}'; leave it None"):
        build(type("Wrong", (isaac_lab.MapObservation,), {"quaternions": wrong}), env, sensor_cfg="sensor")


def test_refuses_a_sensor_inside_the_robot(version):
    around = torch.nn.functional.normalize(torch.randn(B, 50, 3, generator=torch.Generator().manual_seed(0)), dim=-1)
    env = {"robot": version.robot()}
    inside = version.caster(hits=BASE[:, None] + 0.1 * around, global_world_only=False)
    with pytest.raises(ValueError, match="'sensor' must see more than the robot .* set global_world_only=True"):
        build(isaac_lab.MapObservation, Env(**env, sensor=inside), sensor_cfg="sensor")
    low = version.caster(hits=BASE[:, None] - 0.1 * around.abs(), global_world_only=False)  # near the ground
    build(isaac_lab.MapObservation, Env(**env, sensor=low), sensor_cfg="sensor")


def test_refuses_parallel_rays(version):
    caster = version.caster()
    starts = isaac_lab.to_tensor(caster.ray_starts).clone()
    starts[..., 0] += torch.linspace(-0.8, 0.8, starts.shape[1])
    caster.ray_starts = version.array(starts)
    with pytest.raises(
        ValueError, match="the rays of 'sensor' must start at one point, .* got starts that are up to 1.6"
    ):
        begin(version, caster)


def test_refuses_another_order_of_quaternions():
    class Other(isaac_lab.MapObservation):
        quaternions = "zyxw"

    with pytest.raises(ValueError, match="quaternions: must be 'wxyz', 'xyzw' or None, got 'zyxw'"):
        build(Other, Env(robot=Version(2).robot(), sensor=Version(2).caster()), sensor_cfg="sensor")


MANAGERS = """
class ManagerTermBase:
    def __init__(self, cfg, env):
        self.cfg, self._env = cfg, env
    def reset(self, env_ids=None):
        pass
    def __call__(self, *args):
        raise NotImplementedError
"""

CHECK = """
import inspect, torch
from isaaclab.managers import ManagerTermBase
from tests.integrations.simulators import Env
from tests.integrations.test_isaac_lab import Version
from torchelev.integrations.isaac_lab import MapObservation

assert issubclass(MapObservation, ManagerTermBase)
version = Version(2)
env = Env(robot=version.robot(), sensor=version.caster())
from types import SimpleNamespace
cfg = SimpleNamespace(params={"sensor_cfg": "sensor"})
term = MapObservation(cfg=cfg, env=env)
assert term._env is env and term.cfg is cfg

# Isaac Lab compares the names of the parameters with those of the call.
parameters = inspect.signature(term).parameters
optional = [name for name, one in parameters.items() if one.default is not inspect.Parameter.empty]
required = [name for name in parameters if name not in optional]
assert set((required + optional)[1:]) == set(list(cfg.params) + optional)

term.reset(torch.arange(3))
assert term(env, **cfg.params).shape == (3, 187)
assert term.emap.layer("validity").any()
term.reset([1])
assert not term.emap.layer("validity")[1].any()
print("accepted")
"""


@pytest.mark.slow(3)
def test_is_a_term_that_isaac_lab_s_manager_accepts(tmp_path):
    """With a package `isaaclab` installed, the term derives from its base class."""
    package = tmp_path / "isaaclab"
    package.mkdir()
    (package / "__init__.py").write_text("")
    (package / "managers.py").write_text(MANAGERS)
    done = run_python(CHECK, path=tmp_path)
    assert done.stdout.strip() == "accepted", done.stderr
