"""What a MuJoCo scene shows of the ground: rays and rendered depth, as `torchelev.gym` takes them, and height fields.

    rays = MujocoRays(model, "torso", directions, T_body_sensor)
    env = ElevationMapObservation(
        env, points=lambda env: rays.points(env.unwrapped.data),
        T_map_sensor=lambda env: rays.T_map_sensor(env.unwrapped.data), T_map_base=..., dt=env.unwrapped.dt)

Run with MuJoCo 4.0: docs/howto/mujoco.md. `torchelev.integrations.mujoco_warp` does the same for many worlds.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
import torch
from torch import Tensor

from torchelev.errors import require, require_positive
from torchelev.frames import change_axes, transform_matrix
from torchelev.integrations.scene import check_directions, own_geoms, pinhole, require_plain_camera
from torchelev.sim import HeightField, surface_of

try:
    import mujoco
except ModuleNotFoundError:  # documentation and help read this file without it
    mujoco = None

if TYPE_CHECKING:
    from jaxtyping import Float


class MujocoRays:
    """The rays of a sensor on a body, cast by `mj_multiRay`.

    They pass through the body that carries the sensor, and return nothing where they hit the rest of the robot: bodies
    of the same tree.

    Args:
        model: the model.
        body: name of the body that carries the sensor.
        directions: unit vectors of the rays, sensor frame.
        T_body_sensor: place of the sensor on the body.
        max_distance: range [m], beyond which a ray returns nothing.

    Raises:
        ValueError: there is no such body, or directions are no unit vectors.
    """

    def __init__(
        self,
        model: mujoco.MjModel,
        body: str,
        directions: Float[Tensor, "N 3"],
        T_body_sensor: Float[Tensor, "4 4"],
        max_distance: float = 10.0,
    ) -> None:
        require_positive(max_distance=max_distance)
        self.model, self.body, self.max_distance = model, find_body(model, body), max_distance
        self.directions = check_directions(directions).double().cpu()
        self.T_body_sensor = T_body_sensor.double().cpu()
        self._is_own = own_geoms(model, self.body)

    def T_map_body(self, data: mujoco.MjData) -> Float[Tensor, "4 4"]:
        """Return the pose of the body."""
        return transform_matrix(data.xpos[self.body], data.xmat[self.body])

    def T_map_sensor(self, data: mujoco.MjData) -> Float[Tensor, "4 4"]:
        """Return the pose of the sensor."""
        return self.T_map_body(data) @ self.T_body_sensor

    def points(self, data: mujoco.MjData) -> Float[Tensor, "N 3"]:
        """Return where the rays end [m], sensor frame; NaN where they hit nothing within range, or the robot itself."""
        T = self.T_map_sensor(data).numpy()
        geom, distance = np.zeros(len(self.directions), np.int32), np.zeros(len(self.directions))
        rays = (self.directions.numpy() @ T[:3, :3].T).ravel()
        skipped = None, 1, self.body  # no groups of geoms, static ones too, but the body of the sensor
        args = self.model, data, T[:3, 3].copy(), rays, *skipped, geom, distance, None, len(geom), self.max_distance
        mujoco.mj_multiRay(*args)
        # Planes, height fields and large geoms are hit beyond the cutoff.
        is_hit = (geom >= 0) & ~self._is_own[geom] & (distance <= self.max_distance)
        return self.directions * torch.from_numpy(np.where(is_hit, distance, np.nan))[:, None]


class MujocoCamera:
    """A camera of the model whose depth image MuJoCo renders.

    It sees the robot itself: leave that out by `SensorConfig(body=...)`, or by `groups`.

    Args:
        model: the model.
        camera: name of a perspective camera that is given by fovy.
        width: [pixels].
        height: [pixels].
        max_distance: range [m] along the axis, beyond which a pixel returns nothing.
        groups: groups of geoms that it sees; None: all that MuJoCo shows by default, 0 to 2.

    Raises:
        ValueError: there is no such camera, or it is orthographic or given by its sensor's size.
    """

    def __init__(
        self,
        model: mujoco.MjModel,
        camera: str,
        width: int,
        height: int,
        max_distance: float = 10.0,
        groups: tuple[int, ...] | None = None,
    ) -> None:
        require_positive(max_distance=max_distance)
        self.camera, self.max_distance = find_camera(model, camera), max_distance
        #: K (3, 3) [pixels], which `MapFeed` takes as `intrinsics`
        self.intrinsics = pinhole(torch.tensor(model.cam_fovy[self.camera], dtype=torch.float64), width, height)
        self._renderer = mujoco.Renderer(model, height, width)
        self._renderer.enable_depth_rendering()
        self._options = mujoco.MjvOption()
        if groups is not None:
            self._options.geomgroup[:] = [group in groups for group in range(mujoco.mjNGROUP)]

    def T_map_sensor(self, data: mujoco.MjData) -> Float[Tensor, "4 4"]:
        """Return the pose of the camera's optical frame: x right, y down, z forward."""
        T = transform_matrix(data.cam_xpos[self.camera], data.cam_xmat[self.camera])
        return change_axes(T, "opengl", "optical")

    def depth(self, data: mujoco.MjData) -> Float[Tensor, "h w"]:
        """Render depths [m] along the axis; NaN where nothing is within range."""
        self._renderer.update_scene(data, self.camera, self._options)
        depth = torch.from_numpy(self._renderer.render().copy())
        return depth.where(depth < self.max_distance, torch.nan)


def height_field(model: mujoco.MjModel, name: str) -> HeightField:
    """Return a height field of the model with the triangles of its rays and contacts, origin and axes as its geom's.

    The model holds its rows along y, from low to high, whichever way the file had them.

    Raises:
        ValueError: there is no such height field, or its samples are not equally far apart along x and y.
    """
    number = _find(model, mujoco.mjtObj.mjOBJ_HFIELD, "name", "height field", name)
    rows, columns, first = model.hfield_nrow[number], model.hfield_ncol[number], model.hfield_adr[number]
    half_x, half_y, relief, _ = model.hfield_size[number]
    x, y = 2 * half_x / (columns - 1), 2 * half_y / (rows - 1)
    rule, hint = "must have samples equally far apart along x and y", "choose its size by its rows and columns"
    require(abs(x - y) < 1e-6 * x, "name", rule, f"{x:.4g} and {y:.4g} m", hint)
    heights = relief * model.hfield_data[first : first + rows * columns].reshape(rows, columns).T
    return HeightField(torch.from_numpy(heights.copy())[None].float(), float(x), **surface_of("mujoco"))


def find_body(model: mujoco.MjModel, name: str) -> int:
    """Return the number of the body of this name; ValueError if there is none."""
    return _find(model, mujoco.mjtObj.mjOBJ_BODY, "body", "body", name)


def find_camera(model: mujoco.MjModel, name: str) -> int:
    """Return the number of a perspective camera that is given by fovy; ValueError if there is none."""
    number = _find(model, mujoco.mjtObj.mjOBJ_CAMERA, "camera", "camera", name)
    require_plain_camera("camera", name, model, number)
    return number


def _find(model: mujoco.MjModel, kind: mujoco.mjtObj, argument: str, what: str, name: str) -> int:
    number = mujoco.mj_name2id(model, kind, name)
    require(number >= 0, argument, f"must name a {what} of the model", repr(name), "see the names in its XML")
    return number
