"""Small stand-ins of Isaac Lab's and mjlab's interfaces, so that the two terms run without these simulators.

They have the names and shapes that both projects document, as far as the terms use them. Behind them robots climb
stairs in `torchelev.sim`. In your project you do not need this file.
"""

from collections import namedtuple
from types import SimpleNamespace

import torch
from scipy.spatial.transform import Rotation

from torchelev.frames import change_axes
from torchelev.sim import DepthCamera, MountedSensor, make_terrain, mount
from torchelev.sim.poses import pose

SceneEntityCfg = namedtuple("SceneEntityCfg", "name")
ObservationTermCfg = namedtuple("ObservationTermCfg", "func params")


class ManagerTermBase:  # of Isaac Lab
    def __init__(self, cfg, env):
        self.cfg, self._env = cfg, env


class MjlabTermBase:
    def __init__(self, env):
        self._env = env


class Environment:
    """Stand-in of both `ManagerBasedEnv` (Isaac Lab) and `ManagerBasedRlEnv` (mjlab)."""

    def __init__(self, num_envs=8, step_dt=0.1):
        self.num_envs, self.device, self.step_dt = num_envs, "cpu", step_dt
        self.terrain = make_terrain("stairs_down", torch.linspace(0.1, 0.9, num_envs))
        self.tile_ids = torch.arange(num_envs)
        self.origins = self.tile_ids[:, None] * torch.tensor([10.0, -10.0, 0.0], dtype=torch.float64)
        self.camera = MountedSensor(DepthCamera(width=80, height=60, max_range=5.0), mount(pitch_deg=35, x=0.3, z=0.2))
        self.walked, self.common_step_counter = 0.0, 0
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
        T_camera = self.camera.T_map_sensor(T_base)
        entities = {"robot": robot(T_base), "rays": self.rays(T_camera, points)}
        entities["camera"] = self.depth_camera(T_camera, points)
        self.scene = {name: SimpleNamespace(data=SimpleNamespace(**data)) for name, data in entities.items()}

    def depth_camera(self, T, points):
        depth = {"distance_to_image_plane": self.camera.depth(points).nan_to_num(torch.inf)[..., None]}
        K = self.camera.pattern.intrinsics.float().expand(self.num_envs, 3, 3)
        quat = quat_wxyz(change_axes(T, "forward", "optical"))
        return {"pos_w": T[:, :3, 3].float(), "quat_w_ros": quat, "output": depth, "intrinsic_matrices": K}

    def rays(self, T, points):
        hits = (points.double() @ T[:, :3, :3].mT + T[:, None, :3, 3]).float().nan_to_num(0.0)
        distances = torch.linalg.vector_norm(points, dim=-1).nan_to_num(-1.0)  # -1: nothing was hit
        return {"pos_w": T[:, :3, 3].float(), "quat_w": quat_wxyz(T), "hit_pos_w": hits, "distances": distances}


def robot(T):
    position, quat = T[:, :3, 3].float(), quat_wxyz(T)
    names = ("root_pos_w", "root_quat_w"), ("root_link_pos_w", "root_link_quat_w")  # Isaac Lab's, mjlab's
    return {name: value for pair in names for name, value in zip(pair, (position, quat), strict=True)}


def quat_wxyz(T):
    return torch.from_numpy(Rotation.from_matrix(T[:, :3, :3]).as_quat()).roll(1, -1).float()
