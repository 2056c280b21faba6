"""Stand-ins of what the terms read of mjlab and Isaac Lab, for tests without these simulators.

They stand for the documented names and shapes; of Isaac Lab 2.3, which needs Isaac Sim, there is nothing else here.
"""

import math
from types import SimpleNamespace

import numpy as np
import torch
from scipy.spatial.transform import Rotation

from torchelev import ElevationMapConfig, GridConfig
from torchelev.integrations.step_map import to_cloud

CFG = ElevationMapConfig(grid=GridConfig(resolution=0.1, length_x=2.4, length_y=2.4))


class Env:
    """A manager-based environment as far as terms use it."""

    def __init__(self, num_envs=3, step_dt=0.02, **scene):
        self.num_envs, self.device, self.step_dt, self.common_step_counter = num_envs, "cpu", step_dt, 0
        self.scene, self.sim = Scene(scene), SimpleNamespace(mj_model=mujoco_model(), forward=lambda: None)


def mujoco_model(**more):
    """What the term for mjlab reads of a MuJoCo model: a ground in geom group 0, and a robot in group 2."""
    geoms = {"geom_group": np.array([0, 2]), "geom_bodyid": np.array([0, 1]), "body_rootid": np.array([0, 1])}
    return SimpleNamespace(**geoms, **more)


class Scene(dict):
    entities = property(lambda self: {name: part for name, part in self.items() if name == "robot"})
    sensors = property(lambda self: {name: part for name, part in self.items() if name != "robot"})


class GroundSource:
    """Robots at `base` (B, 3) that see flat ground at `height` (B,); counts how often they look."""

    def __init__(self, base, height):
        self.base, self.height, self.reads = base, height, 0

    def read_base(self, env):
        T = torch.eye(4).repeat(len(self.base), 1, 1)
        T[:, :3, 3] = self.base
        return T

    def read_cloud(self, env):
        self.reads += 1
        return to_cloud(ground_hits(self.base, self.height)[:, None], self.base[:, None])


def ground_hits(base, height, spacing=0.05, half=1.0):
    """Points (B, N, 3) of flat ground around each base."""
    axis = torch.arange(-half, half + 1e-6, spacing)
    grid = torch.cartesian_prod(axis, axis)
    hits = torch.cat([base[:, None, :2] + grid, height[:, None, None].expand(-1, len(grid), 1)], -1)
    return hits


def term_cfg(func, **params):
    """The term's config, as the manager passes it to the term."""
    return SimpleNamespace(func=func, params=params, scale=None, noise=None, clip=None)


def build(func, env, **params):
    """Build a term and ask for its shape, as the observation managers of both simulators do; return how to call it."""
    cfg = term_cfg(func, **params)
    term = func(cfg=cfg, env=env)
    blank = term(env, **params)
    return term, lambda: term(env, **params), blank


def quat_wxyz(rotations):
    return torch.from_numpy(np.roll(Rotation.concatenate(rotations).as_quat(), 1, axis=-1)).float()


def mjlab_robot(position, rotations):
    data = SimpleNamespace(root_link_pos_w=position, root_link_quat_w=quat_wxyz(rotations))
    return SimpleNamespace(data=data, indexing=SimpleNamespace(root_body_id=1))


class Pattern:
    """A pattern of mjlab: `generate_rays` returns starts and directions (N, 3) in the frame."""

    def __init__(self, starts, length):
        self.starts, self.length = starts, length

    def generate_rays(self, mj_model, device):
        return self.starts, torch.tensor([[0.0, 0.0, -self.length]]).expand(len(self.starts), 3)


def mjlab_rays(frame_pos, hits, starts=None, length=1.0, groups=(0,)):
    """mjlab's RayCastSensor with F frames (B, F, 3) of N rays (B, F, N, 3); hits that are NaN are misses.

    A miss has distance -1 and lies at its ray's origin.
    """
    B, F, N = hits.shape[:3]
    distances = (hits - frame_pos[:, :, None]).norm(dim=-1).nan_to_num(-1.0).flatten(1)
    hit_pos = torch.where(hits.isnan(), frame_pos[:, :, None], hits).flatten(1, 2)
    data = SimpleNamespace(distances=distances, hit_pos_w=hit_pos, frame_pos_w=frame_pos)
    pattern = Pattern(torch.zeros(N, 3) if starts is None else starts, length)
    cfg = SimpleNamespace(pattern=pattern, include_geom_groups=groups)
    return SimpleNamespace(cfg=cfg, data=data, num_frames=F, num_rays_per_frame=N)


def pinhole(fovy, height, width, half_pixel=0.5):
    """Directions (h * w, 3) of pixels, optical axes, one after the other as loops; depth along z is 1."""
    focal = height / (2 * math.tan(math.radians(fovy) / 2))
    rows = [
        [(u + half_pixel - width / 2) / focal, (v + half_pixel - height / 2) / focal, 1.0]
        for v in range(height)
        for u in range(width)
    ]
    return np.array(rows), focal


def look_down(position, R_map_optical, directions, ground=0.0):
    """Depth (h * w,) along z of flat ground, inf where a ray never meets it."""
    slope = (directions @ R_map_optical.T)[:, 2]
    with np.errstate(divide="ignore"):
        depth = (ground - position[2]) / slope
    return np.where(slope < 0, depth, np.inf)
