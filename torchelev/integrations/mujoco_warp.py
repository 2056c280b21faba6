"""What the worlds of a MuJoCo Warp simulation show of the ground, as `torchelev.gym.MapFeed` takes it.

    rays = WarpRays(mj_model, model, data, "torso", directions, T_body_sensor)
    feed = MapFeed(data.nworld, points=lambda env: rays.points(), T_map_sensor=lambda env: rays.T_map_sensor(), ...)

Torch and Warp share the memory of poses, rays and distances. Run with MuJoCo Warp 4.0: docs/howto/mujoco.md.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import torch
from torch import Tensor

from torchelev.errors import require_positive
from torchelev.frames import change_axes, transform_matrix
from torchelev.integrations.mujoco import find_body, find_camera
from torchelev.integrations.scene import check_directions, own_geoms, pinhole

try:
    import mujoco_warp
    import warp as wp
except ModuleNotFoundError:  # documentation and help read this file without them
    mujoco_warp = wp = None

if TYPE_CHECKING:
    import mujoco
    from jaxtyping import Float


class WarpRays:
    """The rays of a sensor on a body in all worlds, cast by `mujoco_warp.rays`.

    They pass through the body that carries the sensor, and return nothing where they hit the rest of the robot: bodies
    of the same tree.

    Args:
        mj_model: the model on the host.
        model: the same on the device.
        data: of B worlds, read at each call.
        body: name of the body that carries the sensor.
        directions: unit vectors of the rays, sensor frame.
        T_body_sensor: place of the sensor on the body.
        max_distance: range [m], beyond which a ray returns nothing.

    Raises:
        ValueError: there is no such body, or directions are no unit vectors.
    """

    def __init__(
        self,
        mj_model: mujoco.MjModel,
        model: mujoco_warp.Model,
        data: mujoco_warp.Data,
        body: str,
        directions: Float[Tensor, "N 3"],
        T_body_sensor: Float[Tensor, "4 4"],
        max_distance: float = 10.0,
    ) -> None:
        require_positive(max_distance=max_distance)
        self.model, self.data, self.body, self.max_distance = model, data, find_body(mj_model, body), max_distance
        device = torch.device(str(wp.device_to_torch(data.xpos.device)))
        self.directions = check_directions(directions).float().to(device)
        self.T_body_sensor = T_body_sensor.float().to(device)
        # Geom -1 is a miss: it reads the last entry.
        is_ground = torch.from_numpy(~own_geoms(mj_model, self.body))
        self._is_ground = torch.cat([is_ground, torch.zeros(1, dtype=torch.bool)]).to(device)
        B, N = data.nworld, len(self.directions)
        self._origins, self._rays = (torch.zeros(B, N, 3, device=device) for _ in range(2))
        self._distance = torch.zeros(B, N, device=device)
        self._geom = torch.zeros(B, N, dtype=torch.int32, device=device)
        normal, skipped = torch.zeros(B, N, 3, device=device), torch.full((N,), self.body, device=device)
        vectors = (wp.from_torch(value, dtype=wp.vec3) for value in (self._origins, self._rays))
        results = (wp.from_torch(self._distance), wp.from_torch(self._geom), wp.from_torch(normal, dtype=wp.vec3))
        groups = wp.types.vector(6, float)(-1.0)
        self._args = *vectors, groups, True, wp.from_torch(skipped.int()), *results

    def T_map_body(self) -> Float[Tensor, "B 4 4"]:
        """Return the poses of the body."""
        return transform_matrix(_shared(self.data.xpos)[:, self.body], _shared(self.data.xmat)[:, self.body])

    def T_map_sensor(self) -> Float[Tensor, "B 4 4"]:
        """Return the poses of the sensor."""
        return self.T_map_body() @ self.T_body_sensor

    def points(self) -> Float[Tensor, "B N 3"]:
        """Return where the rays end [m], sensor frame; NaN where they hit nothing within range, or the robot itself."""
        T = self.T_map_sensor()
        self._origins.copy_(T[:, None, :3, 3].expand_as(self._origins))
        # Elementwise: a GPU may round a matrix product to ten bits.
        self._rays.copy_((T[:, None, :3, :3] * self.directions[:, None]).sum(-1))
        mujoco_warp.rays(self.model, self.data, *self._args)
        is_hit = self._is_ground[self._geom.long()] & (self._distance <= self.max_distance)
        return self.directions * torch.where(is_hit, self._distance, torch.nan)[..., None]


class WarpCamera:
    """A camera of the model whose depth images MuJoCo Warp renders in all worlds.

    Args:
        mj_model: the model on the host.
        model: the same on the device.
        data: of B worlds, read at each call.
        camera: name of a perspective camera that is given by fovy.
        width: [pixels].
        height: [pixels].
        max_distance: range [m] along the axis, beyond which a pixel returns nothing.
        groups: groups of geoms that it sees.

    Raises:
        ValueError: there is no such camera, or it is orthographic or given by its sensor's size.
    """

    def __init__(
        self,
        mj_model: mujoco.MjModel,
        model: mujoco_warp.Model,
        data: mujoco_warp.Data,
        camera: str,
        width: int,
        height: int,
        max_distance: float = 10.0,
        groups: tuple[int, ...] = (0, 1, 2),
    ) -> None:
        require_positive(max_distance=max_distance)
        self.model, self.data, self.max_distance = model, data, max_distance
        self.camera = find_camera(mj_model, camera)
        #: K (3, 3) [pixels], which `MapFeed` takes as `intrinsics`
        self.intrinsics = pinhole(torch.tensor(mj_model.cam_fovy[self.camera], dtype=torch.float64), width, height)
        options: dict[str, Any] = {"render_rgb": False, "render_depth": True, "enabled_geom_groups": list(groups)}
        self._context = mujoco_warp.create_render_context(
            mj_model, data.nworld, (width, height), cam_active=[camera], **options
        )
        # Not mujoco_warp.get_depth, which clamps to its scale: what is farther would become a wall.
        self._depth = _shared(self._context.depth_data).view(data.nworld, height, width)

    def T_map_sensor(self) -> Float[Tensor, "B 4 4"]:
        """Return the poses of the camera's optical frame: x right, y down, z forward."""
        data = self.data
        T = transform_matrix(_shared(data.cam_xpos)[:, self.camera], _shared(data.cam_xmat)[:, self.camera])
        return change_axes(T, "opengl", "optical")

    def depth(self) -> Float[Tensor, "B h w"]:
        """Render depths [m] along the axis; NaN where nothing is within range."""
        mujoco_warp.refit_bvh(self.model, self.data, self._context)
        mujoco_warp.render(self.model, self.data, self._context)
        is_hit = (self._depth > 0) & (self._depth < self.max_distance)
        return torch.where(is_hit, self._depth, torch.nan)


def _shared(array: Any) -> Tensor:
    """Return a Warp array as a tensor of the same memory."""
    return wp.to_torch(array)
