"""Maps of the worlds of a Newton model, fed by ray casts or depth cameras.

    maps = NewtonMaps(model, "base", [NewtonLidar(directions, T_base_sensor), NewtonCamera(64, 48, 1.0, T_base_camera)])
    maps.update(state, dt=0.02)
    values, valid = HeightScan.isaac_lab()(maps.emap, maps.T_map_base)

Run with Newton 1.8.0: docs/howto/newton.md. Torch and Warp share the memory of poses, rays and distances: nothing is
copied, and on a GPU the host does not wait.
"""

from __future__ import annotations

import contextlib
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from torch import Tensor

from torchelev import ElevationMap, ElevationMapConfig
from torchelev.errors import require, require_count, require_positive
from torchelev.frames import transform_xyzw
from torchelev.integrations.newton_casts import CameraCast, RayCast
from torchelev.integrations.scene import check_directions
from torchelev.integrations.step_map import Cloud, join

try:
    import newton
    import warp as wp
except ModuleNotFoundError:  # documentation and help read this file without them
    newton = wp = None

if TYPE_CHECKING:
    from jaxtyping import Bool, Float, Int

# Rotations that turn a world's up axis to z.
_R_MAP_WORLD = {
    0: [[0.0, 1, 0], [0, 0, 1], [1, 0, 0]],
    1: [[1.0, 0, 0], [0, 0, -1], [0, 1, 0]],
    2: [[1.0, 0, 0], [0, 1, 0], [0, 0, 1]],
}
_UPRIGHT = 0.5  # height of the end of the base's z axis at the start, below which its axes are probably others


@dataclass(frozen=True)
class NewtonLidar:
    """A lidar: rays from one point.

    Raises:
        ValueError: the directions are no unit vectors, or the range is not positive.
    """

    directions: Float[Tensor, "R 3"]  #: unit vectors, sensor frame
    T_base_sensor: Float[Tensor, "4 4"]  #: place of the sensor in the base frame
    max_distance: float = 30.0  #: [m] beyond which a ray returns nothing

    def __post_init__(self) -> None:
        check_directions(self.directions)
        require_positive(max_distance=self.max_distance)


@dataclass(frozen=True)
class NewtonCamera:
    """A pinhole camera, x forward, y left, z up.

    Raises:
        ValueError: a number is out of range.
    """

    width: int  #: [pixels]
    height: int  #: [pixels]
    fov: float  #: [rad] vertical field of view
    T_base_sensor: Float[Tensor, "4 4"]  #: place of the camera in the base frame
    max_distance: float = 10.0  #: [m] along its axis, beyond which a pixel returns nothing

    def __post_init__(self) -> None:
        for name in ("width", "height"):
            require_count(name, getattr(self, name), "give pixels")
        require(0 < self.fov < np.pi, "fov", "must lie in (0, pi) rad", self.fov, "give the vertical field of view")
        require_positive(max_distance=self.max_distance)


class NewtonMaps:
    """One map for each world of a model.

    Args:
        model: of B worlds, as its builder replicates them. The map frame is the worlds' frame, turned about x if y
            is up.
        base: label of the body that carries the sensors, in each world.
        sensors: read at each update as one measurement.
        cfg: config of the maps.
        T_body_base: the base frame (x forward, z up) in that body's frame; None: they are the same.
        keep_own: keep what rays hit of the robot itself, for `cfg.sensor.body` to leave out; else such rays return
            nothing.

    Raises:
        ImportError: Newton is not installed.
        ValueError: the body is missing in a world, its z axis points sideways at the start, there is no sensor, or one
            sees the robot alone.
    """

    def __init__(
        self,
        model: newton.Model,
        base: str,
        sensors: Sequence[NewtonLidar | NewtonCamera],
        cfg: ElevationMapConfig | None = None,
        T_body_base: Float[Tensor, "4 4"] | None = None,
        keep_own: bool = False,
    ) -> None:
        require(newton is not None, "newton", "must be installed", "no such module", "pip install newton", ImportError)
        require(len(sensors) > 0, "sensors", "must not be empty", "none", "give a NewtonLidar or a NewtonCamera")
        self.model, self._device = model, torch.device(wp.device_to_torch(model.device))
        like: dict[str, Any] = {"device": self._device, "dtype": torch.float64}
        self._bodies = torch.from_numpy(_find_bodies(model, base)).to(self._device)
        self._T_map_world = torch.eye(4, **like)
        self._T_map_world[:3, :3] = torch.tensor(_R_MAP_WORLD[int(model.up_axis)], **like)
        self._T_body_base = torch.eye(4, **like) if T_body_base is None else T_body_base.to(**like)
        own = None if keep_own else _find_own(model, self._bodies.tolist())
        self._readers = [_Reader(model, one, None if own is None else own.to(self._device)) for one in sensors]
        self.emap = ElevationMap(cfg, num_envs=model.world_count, device=self._device)
        self.T_map_base = self._read_base(model)
        up = self.T_map_base[:, 2, 2].min().item()
        hint = "give T_body_base, the base frame in the body's"
        require(up > _UPRIGHT, "base", "must have its z axis upwards at the start", f"{base!r}: {up:.2f}", hint)
        for number, reader in enumerate(self._readers):
            rule, hint = f"number {number} must see more than the robot itself", "check its T_base_sensor"
            only_own = reader.sees_only_own(model, self._T_world_base())
            require(not only_own, "sensors", rule, "only its own shapes", hint)

    def update(self, state: newton.State, dt: float | Float[Tensor, "B"]) -> None:
        """Measure with all sensors, and fuse what they saw.

        Args:
            state: poses of the bodies.
            dt: time since the last update [s]; 0 where a world was just reset.
        """
        with _shared_stream(self._device):
            self.model.bvh_refit_shapes(state)
            self.T_map_base = self._read_base(state)
            cloud = join([self._read_cloud(reader, state) for reader in self._readers])
            self.emap.update(cloud.points, cloud.T_map_sensor, self.T_map_base, dt)

    def reset(self, worlds: Int[Tensor, "K"] | None = None, *, mask: Bool[Tensor, "B"] | None = None) -> None:
        """Forget the maps of worlds that restart, by number or by mask; without both, of all."""
        self.emap.reset(worlds, mask=mask)

    def _read_cloud(self, reader: _Reader, state: newton.State) -> Cloud:
        points = reader.read(state, self._T_world_base())
        return Cloud(points[:, None], (self.T_map_base @ reader.T_base_sensor)[:, None])

    def _T_world_base(self) -> Float[Tensor, "B 4 4"]:  # noqa: N802
        return self._T_map_world.mT @ self.T_map_base  # a rotation

    def _read_base(self, state: newton.State | newton.Model) -> Float[Tensor, "B 4 4"]:
        pose = wp.to_torch(state.body_q)[self._bodies].double()
        return self._T_map_world @ transform_xyzw(pose[:, :3], pose[:, 3:]) @ self._T_body_base


@dataclass(eq=False)
class _Reader:
    """Casts the rays of one sensor in all worlds."""

    model: newton.Model
    sensor: NewtonLidar | NewtonCamera
    own: Bool[Tensor, "B shapes"] | None  #: shapes of each world's own robot; None: they are kept
    rays: Float[Tensor, "R 3"] = field(init=False)  #: [m] sensor frame, of which distances are multiples
    T_base_sensor: Float[Tensor, "4 4"] = field(init=False)

    def __post_init__(self) -> None:
        device = wp.device_to_torch(self.model.device)
        self.T_base_sensor = self.sensor.T_base_sensor.to(device, torch.float64)
        self._cast = (
            CameraCast(self.model, self.sensor)
            if isinstance(self.sensor, NewtonCamera)
            else RayCast(self.model, self.sensor)
        )
        self.rays = self._cast.rays.to(device)

    def read(self, state: newton.State, T_world_base: Float[Tensor, "B 4 4"]) -> Float[Tensor, "B R 3"]:
        """Return the points [m] in the sensor's frame, NaN where a ray returns nothing."""
        distance, is_hit, is_own = self._hits(state, T_world_base)
        return self.rays * torch.where(is_hit & ~is_own, distance, torch.nan)[..., None]

    def sees_only_own(self, state: newton.State | newton.Model, T_world_base: Float[Tensor, "B 4 4"]) -> bool:
        """Return whether the sensor hits the robot of some world and nothing else. The host waits for the device."""
        _, is_hit, is_own = self._hits(state, T_world_base)
        return bool((is_hit.any(1) & (is_hit & ~is_own).logical_not().all(1)).any())

    def _hits(self, state: Any, T_world_base: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Return distances [m], where something was hit within range, and where that is the robot itself, (B, R)."""
        distance, shape = self._cast(state, T_world_base @ self.T_base_sensor)
        is_hit = (distance > 0) & (distance <= self.sensor.max_distance)
        if self.own is None:
            return distance, is_hit, torch.zeros_like(is_hit)
        return distance, is_hit, self.own.gather(1, shape.clamp(0, self.own.shape[1] - 1))


def _find_bodies(model: newton.Model, label: str) -> np.ndarray:
    """Return the number of the body of this label in each world; ValueError unless each has one."""
    labels, worlds = np.array(model.body_label), model.body_world.numpy()
    is_it = (labels == label) | np.char.endswith(labels, f"/{label}")
    (found,) = np.nonzero(is_it & (worlds >= 0))
    fits = np.array_equal(worlds[found], np.arange(model.world_count))
    known = ", ".join(dict.fromkeys(labels.tolist()))
    rule = f"must be a body of each of the {model.world_count} worlds, once"
    require(fits, "base", rule, f"{label!r} in worlds {worlds[found].tolist()}", f"bodies are {known}")
    return found


def _find_own(model: newton.Model, bases: list[int]) -> Bool[Tensor, "B shapes"]:
    """Return which shapes are on bodies that joints connect with the base of each world."""
    robot = {body: world for world, body in enumerate(bases)}
    pairs = list(zip(model.joint_parent.numpy().tolist(), model.joint_child.numpy().tolist(), strict=True))
    is_growing = True
    while is_growing:
        joined = [(a, b) for pair in pairs for a, b in (pair, pair[::-1]) if a in robot and b >= 0 and b not in robot]
        robot |= {b: robot[a] for a, b in joined}
        is_growing = bool(joined)
    own = torch.zeros(len(bases), max(1, model.shape_count), dtype=torch.bool)
    for shape, body in enumerate(model.shape_body.numpy().tolist()):
        if body in robot:
            own[robot[body], shape] = True
    return own


@contextlib.contextmanager
def _shared_stream(device: torch.device) -> Any:
    """Let Warp work in torch's stream, so that each sees what the other wrote."""
    if device.type != "cuda":
        yield
        return
    with wp.ScopedStream(wp.stream_from_torch(torch.cuda.current_stream(device))):
        yield
