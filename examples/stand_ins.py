"""Small stand-ins of Isaac Lab's and mjlab's interfaces, so that the two terms run without these simulators.

They have the documented names and shapes of both projects that the terms use. Behind them robots climb
stairs in `torchelev.sim`. In your project you do not need this file.
"""

from collections import namedtuple
from types import SimpleNamespace

import torch
from scipy.spatial.transform import Rotation

from torchelev.frames import change_axes
from torchelev.sim import DepthCamera, MountedSensor, make_terrain, mount
from torchelev.sim.poses import pose

ObservationTermCfg = namedtuple("ObservationTermCfg", "func params")
SceneEntityCfg = namedtuple("SceneEntityCfg", "name")


class Scene(dict):
    """The robot and the sensors by name."""

    entities = property(lambda self: {"robot": self["robot"]})
    sensors = property(lambda self: {name: part for name, part in self.items() if name != "robot"})


class PinholeCameraPattern:
    def generate_rays(self, mj_model, device):
        return torch.zeros(80 * 60, 3), None  # all start at the sensor; their directions are not needed


class Environment:
    """Stand-in of both `ManagerBasedRLEnv` (Isaac Lab) and `ManagerBasedRlEnv` (mjlab)."""

    def __init__(self, num_envs=8, step_dt=0.1):
        self.num_envs, self.device, self.step_dt = num_envs, "cpu", step_dt
        self.terrain = make_terrain("stairs_down", torch.linspace(0.1, 0.9, num_envs))
        self.tile_ids = torch.arange(num_envs)
        self.origins = self.tile_ids[:, None] * torch.tensor([10.0, -10.0, 0.0], dtype=torch.float64)
        self.camera = MountedSensor(DepthCamera(width=80, height=60, max_range=5.0), mount(pitch_deg=35, x=0.3, z=0.2))
        self.sim, self.walked, self.common_step_counter = SimpleNamespace(mj_model=None, forward=lambda: None), 0.0, -1
        self.step()

    def step(self, distance=0.05):
        """Walk ahead and measure."""
        self.walked, self.common_step_counter = self.walked + distance, self.common_step_counter + 1
        yaw = torch.linspace(-0.5, 0.5, self.num_envs, dtype=torch.float64)
        xy = self.walked * torch.stack([yaw.cos(), yaw.sin()], -1)
        z = self.terrain.truth(self.tile_ids, xy[:, None].float()).double() + 0.5
        T_base = pose(torch.cat([xy, z], -1), yaw)
        points = self.camera(self.terrain.field, self.tile_ids, T_base)
        T_base[:, :3, 3] += self.origins
        T = self.camera.T_map_sensor(T_base)
        robot = SimpleNamespace(root_link_pos_w=T_base[:, :3, 3].float(), root_link_quat_w=quat_wxyz(T_base))
        self.scene = Scene(robot=SimpleNamespace(data=robot), camera=self.depth_camera(T, points), rays=rays(T, points))

    def depth_camera(self, T, points):
        """Isaac Lab's `RayCasterCamera`: pixels are counted from the image's corner, so centres are at 0.5, 1.5, ..."""
        depth = {"distance_to_image_plane": self.camera.depth(points).nan_to_num(torch.inf)[..., None]}
        K = self.camera.pattern.intrinsics.float().expand(self.num_envs, 3, 3).clone()
        K[:, :2, 2] += 0.5
        quat = quat_wxyz(change_axes(T, "forward", "optical"))
        data = SimpleNamespace(pos_w=T[:, :3, 3].float(), quat_w_ros=quat, output=depth, intrinsic_matrices=K)
        return SimpleNamespace(cfg=SimpleNamespace(data_types=list(depth), update_period=0.0), data=data)


def rays(T, points):
    """Return mjlab's `RayCastSensor`: hits in the world frame; -1 says that nothing was hit."""
    hits = (points.double() @ T[:, :3, :3].mT + T[:, None, :3, 3]).float().nan_to_num(0.0)
    distances = torch.linalg.vector_norm(points, dim=-1).nan_to_num(-1.0)
    data = SimpleNamespace(frame_pos_w=T[:, None, :3, 3].float(), hit_pos_w=hits, distances=distances)
    cfg = SimpleNamespace(pattern=PinholeCameraPattern())
    return SimpleNamespace(cfg=cfg, data=data, num_frames=1, num_rays_per_frame=hits.shape[1])


def quat_wxyz(T):
    return torch.from_numpy(Rotation.from_matrix(T[:, :3, :3]).as_quat()).roll(1, -1).float()
