"""Ray casts and depth cameras of Newton, in memory that Torch and Warp share."""

from __future__ import annotations

from typing import TYPE_CHECKING

import torch
from torch import Tensor

from torchelev.frames import change_axes
from torchelev.frames.axes import turn

try:
    import newton
    import warp as wp
except ModuleNotFoundError:  # documentation and help read this file without them
    newton = wp = None

if TYPE_CHECKING:
    from jaxtyping import Float

    from torchelev.integrations.newton import NewtonCamera, NewtonLidar


class RayCast:
    """Distances along unit rays by `newton.intersect_ray`, -1 for a miss."""

    def __init__(self, model: newton.Model, sensor: NewtonLidar) -> None:
        self._model, device = model, wp.device_to_torch(model.device)
        self.rays = sensor.directions.to(device, torch.float32)
        B, R = model.world_count, len(self.rays)
        self._origins, self._directions = (torch.zeros(B, R, 3, device=device) for _ in range(2))
        worlds = torch.arange(B, dtype=torch.int32, device=device).repeat_interleave(R)
        self._distance = torch.zeros(B, R, device=device)
        self._shape = torch.zeros(B, R, dtype=torch.int32, device=device)
        self._arrays = {
            "ray_origins": wp.from_torch(self._origins.view(-1, 3), dtype=wp.vec3),
            "ray_directions": wp.from_torch(self._directions.view(-1, 3), dtype=wp.vec3),
            "ray_worlds": wp.from_torch(worlds),
            "out_dist": wp.from_torch(self._distance.view(-1)),
            "out_shape_id": wp.from_torch(self._shape.view(-1)),
        }

    def __call__(self, state: newton.State, T: Float[Tensor, "B 4 4"]) -> tuple[Tensor, Tensor]:
        """Return distances [m] and numbers of the shapes, (B, R)."""
        T = T.float()
        self._origins.copy_(T[:, None, :3, 3].expand_as(self._origins))
        # Elementwise: a GPU may round a matrix product to ten bits.
        self._directions.copy_((T[:, None, :3, :3] * self.rays[:, None]).sum(-1))
        newton.intersect_ray(self._model, **self._arrays)
        return self._distance, self._shape.long()


class CameraCast:
    """Depths along the axis of `newton.sensors.SensorCamera`, 0 for a miss."""

    def __init__(self, model: newton.Model, sensor: NewtonCamera) -> None:
        size, B = (sensor.width, sensor.height), model.world_count
        self._camera = newton.sensors.SensorCamera(model, load_textures=False)
        self._camera_rays = self._camera.compute_camera_rays_pinhole(*size, camera_fov=sensor.fov, device=model.device)
        directions = wp.to_torch(self._camera_rays)[:, :, 0, 1].reshape(-1, 3)
        at_1_m = directions / -directions[:, 2:]  # along the axis
        self.rays = torch.stack(turn(at_1_m.unbind(-1), "opengl", "forward"), -1)
        self._depth = self._camera.allocate_image_depth_forward(B, *size)
        self._shapes = self._camera.allocate_image_shape_index(B, *size)
        self._poses = torch.zeros(B, 7, device=directions.device)

    def __call__(self, state: newton.State, T: Float[Tensor, "B 4 4"]) -> tuple[Tensor, Tensor]:
        """Return depths [m] and numbers of the shapes, (B, R)."""
        self._poses[:, :3] = T[:, :3, 3]
        self._poses[:, 3:] = _quat_xyzw(change_axes(T, "forward", "opengl")[:, :3, :3])
        poses = wp.from_torch(self._poses, dtype=wp.transformf)
        images = {"forward_depth_image": self._depth, "shape_index_image": self._shapes}
        self._camera.update(state, poses, self._camera_rays, **images)
        shape = wp.to_torch(self._shapes.view(wp.int32)).flatten(1).long()
        return wp.to_torch(self._depth).flatten(1), shape


def _quat_xyzw(R: Float[Tensor, "B 3 3"]) -> Float[Tensor, "B 4"]:
    """Return the unit quaternions of rotations: the largest column of 4 q q^T, which is never small."""
    xx, yy, zz = R.diagonal(dim1=1, dim2=2).unbind(-1)
    xy, xz, yz = R[:, 0, 1] + R[:, 1, 0], R[:, 0, 2] + R[:, 2, 0], R[:, 1, 2] + R[:, 2, 1]
    xw, yw, zw = R[:, 2, 1] - R[:, 1, 2], R[:, 0, 2] - R[:, 2, 0], R[:, 1, 0] - R[:, 0, 1]
    rows = [[1 + xx - yy - zz, xy, xz, xw], [xy, 1 - xx + yy - zz, yz, yw], [xz, yz, 1 - xx - yy + zz, zw]]
    K = torch.stack([torch.stack(row, -1) for row in [*rows, [xw, yw, zw, 1 + xx + yy + zz]]], -2)
    largest = K.diagonal(dim1=1, dim2=2).argmax(-1)
    return torch.nn.functional.normalize(K.gather(1, largest.view(-1, 1, 1).expand(-1, 1, 4))[:, 0], dim=-1)
