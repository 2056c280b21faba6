"""An observation term for Isaac Lab: a map made by ray casters or depth cameras, in place of `mdp.height_scan`.

    height_scan = ObservationTermCfg(
        func=MapObservation, params={"sensor_cfg": SceneEntityCfg("camera"), "standing_height": 0.5})

Written from the documentation and code of Isaac Lab 2.3 and 3.0, and run against stand-ins of their interfaces: not
tried with the simulator itself. docs/howto/isaac_lab.md has the whole config.
"""

from __future__ import annotations

import importlib.util
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, ClassVar

import torch
from torch import Tensor

from torchelev import HeightScan, depth_to_points
from torchelev.errors import require
from torchelev.frames import transform, transform_xyzw
from torchelev.integrations.map_term import MapTerm, Reader
from torchelev.integrations.scene import find, require_one_origin, to_names
from torchelev.integrations.step_map import Cloud, join, require_cadence, to_cloud
from torchelev.observations.patterns import compute_heading

if TYPE_CHECKING:
    from jaxtyping import Float

if importlib.util.find_spec("isaaclab") is None:
    ManagerTermBase: Any = object
else:  # the manager refuses classes that are not derived from it
    from isaaclab.managers import ManagerTermBase  # type: ignore[no-redef]

#: images of distances, and along what they are measured, as `depth_to_points` calls it
DEPTHS = {"distance_to_image_plane": "z", "depth": "z", "distance_to_camera": "ray"}


class MapObservation(MapTerm, ManagerTermBase):
    """Read the map of each environment, which its sensors update once per control step.

    Parameters of the term, read once when Isaac Lab builds it:

    - sensor_cfg: `SceneEntityCfg` of a `RayCasterCamera`, a `Camera` or `TiledCamera` with a depth image, or a
      `RayCaster` whose rays start at one point, such as with a `LidarPatternCfg`; or a list of these.
    - asset_cfg: `SceneEntityCfg` of the robot, whose root link is the base; "robot" if left out.
    - update_every: control steps from one update to the next, for instance the sensor's `update_period` / `step_dt`.
    - standing_height: height of the base over flat ground [m], which an empty map reads.

    Further settings are class attributes: `quaternions` here, and `read`, `map_cfg` and `with_validity` of `MapTerm`.
    By default it reads `HeightScan.isaac_lab()`, which includes the offset of 0.5 m and the clip of +-1 m.

    Raises:
        ValueError, TypeError: for a sensor or asset that is missing or does not fit, and for settings out of range.
    """

    read: ClassVar[Reader] = HeightScan.isaac_lab()
    #: order of quaternions, "wxyz" or "xyzw"; None: x y z w if the robot's data are not tensors, as in Isaac Lab 3
    quaternions: ClassVar[str | None] = None

    def __init__(self, cfg: Any, env: Any) -> None:
        if ManagerTermBase is not object:
            ManagerTermBase.__init__(self, cfg, env)
        sensors = to_names("sensor_cfg", cfg.params.get("sensor_cfg"))
        (asset,) = to_names("asset_cfg", cfg.params.get("asset_cfg", "robot"))
        robot = find(env.scene, "asset_cfg", asset, env.scene.keys())
        source = IsaacLabSource(sensors, asset, _find_order(type(self).quaternions, robot))
        source.check(env, require_cadence(cfg.params.get("update_every", 1)) * env.step_dt)
        self._set_up(cfg, env, source)

    def __call__(
        self,
        env: Any,
        sensor_cfg: Any,
        asset_cfg: Any = "robot",
        update_every: int = 1,
        standing_height: float | None = None,
    ) -> Tensor:
        """Return the observation (B, ...), a fresh tensor without NaN."""
        return self._observe(env)


@dataclass(frozen=True)
class IsaacLabSource:
    """The sensors and the robot in the scene of an Isaac Lab environment."""

    sensor_names: tuple[str, ...]  #: ray casters and cameras, read as one measurement
    asset_name: str  #: the robot
    quaternions: str  #: "wxyz" or "xyzw"

    def check(self, env: Any, period: float) -> None:
        """Refuse sensors that are missing or do not fit, or that measure less often than every `period` [s]."""
        for name in self.sensor_names:
            sensor = find(env.scene, "sensor_cfg", name, env.scene.sensors)
            check = _check_camera if _is_camera(sensor) else _check_rays
            check(name, sensor)
            rule = f"{name!r} must measure at least every {period:.3g} s, from one update of the map to the next"
            hint = "raise update_every, or one measurement counts several times"
            measures = sensor.cfg.update_period <= period * (1 + 1e-6)
            require(measures, "sensor_cfg", rule, f"update_period={sensor.cfg.update_period:.3g}", hint)

    def read_base(self, env: Any) -> Float[Tensor, "B 4 4"]:
        """Return T_map_base, the pose of the robot's root link."""
        robot = env.scene[self.asset_name].data
        return self._pose(robot.root_link_pos_w, robot.root_link_quat_w)

    def read_cloud(self, env: Any) -> Cloud:
        """Return the sensors' latest points."""
        return join([self._read_sensor(env.scene[name]) for name in self.sensor_names])

    def _read_sensor(self, sensor: Any) -> Cloud:
        return self._read_depth(sensor) if _is_camera(sensor) else self._read_rays(sensor)

    def _pose(self, position: Any, quaternion: Any) -> Float[Tensor, "B 4 4"]:
        make = transform if self.quaternions == "wxyz" else transform_xyzw
        return make(to_tensor(position), to_tensor(quaternion))

    def _read_depth(self, sensor: Any) -> Cloud:
        """Return the points of a depth image in optical axes; a miss is inf, NaN or 0."""
        data, name = sensor.data, _find_depth(sensor)
        depth, K = to_tensor(data.output[name]).squeeze(-1), to_tensor(data.intrinsic_matrices).clone()
        K[:, :2, 2] -= 0.5  # Isaac Lab counts pixels from the image's corner, `depth_to_points` from the first centre
        points = depth_to_points(depth, K, along=DEPTHS[name])
        return Cloud(points[:, None], self._pose(data.pos_w, data.quat_w_ros)[:, None])

    def _read_rays(self, sensor: Any) -> Cloud:
        """Return the hits of a ray caster; a miss is inf."""
        data = sensor.data
        T = self._pose(data.pos_w, data.quat_w)
        start = to_tensor(sensor.ray_starts)[:, 0]  # the offset of the sensor's config, which its pose does not include
        R = _align(T, sensor.cfg)
        # Elementwise: a GPU may round a matrix product to ten bits.
        origin = T[:, :3, 3] + (R * start[:, None]).sum(-1)
        return to_cloud(to_tensor(data.ray_hits_w)[:, None], origin[:, None])


def to_tensor(value: Any) -> Tensor:
    """Return Isaac Lab 3's arrays as tensors that share their memory, and tensors as they are."""
    return value if isinstance(value, Tensor) else value.torch


def _find_order(given: str | None, robot: Any) -> str:
    """Return the order of quaternions: the given one, or that of the version that the robot's data look like."""
    is_order, hint = given in (None, "wxyz", "xyzw"), "leave it None, or set the order of your version"
    require(is_order, "quaternions", "must be 'wxyz', 'xyzw' or None", repr(given), hint)
    return given or ("wxyz" if isinstance(robot.data.root_link_quat_w, Tensor) else "xyzw")


def _is_camera(sensor: Any) -> bool:
    return hasattr(sensor.cfg, "data_types")


def _find_depth(sensor: Any) -> str:
    """Return the name of the first depth image that a camera provides, "" if there is none."""
    return next((name for name in DEPTHS if name in sensor.cfg.data_types), "")


def _check_camera(name: str, sensor: Any) -> None:
    cfg = sensor.cfg
    rule, hint = f"{name!r} must have one of {', '.join(DEPTHS)}", 'set data_types=["distance_to_image_plane"]'
    require(_find_depth(sensor) != "", "sensor_cfg", rule, repr(cfg.data_types), hint)
    clipping = getattr(cfg, "depth_clipping_behavior", "none")
    rule, hint = f"{name!r} must not report misses as its maximum distance", 'set depth_clipping_behavior="none"'
    require(clipping != "max", "sensor_cfg", rule, f"depth_clipping_behavior={clipping!r}", hint)
    rule, hint = f"{name!r} must report its current pose", "set update_latest_camera_pose=True"
    follows = getattr(cfg, "update_latest_camera_pose", True)
    require(follows, "sensor_cfg", rule, f"update_latest_camera_pose={follows!r}", hint)


def _check_rays(name: str, sensor: Any) -> None:
    rule, hint = f"{name!r} must be a RayCaster or a camera", "name a sensor of that kind"
    kind = type(sensor).__name__
    require(hasattr(sensor, "ray_starts"), "sensor_cfg", rule, kind, hint, TypeError)
    require_one_origin("sensor_cfg", name, to_tensor(sensor.ray_starts))


def _align(T_map_sensor: Float[Tensor, "B 4 4"], cfg: Any) -> Float[Tensor, "B 3 3"]:
    """Return how a ray caster turns the starts of its rays: with the sensor, with its heading, or not at all."""
    alignment = "yaw" if getattr(cfg, "attach_yaw_only", None) else getattr(cfg, "ray_alignment", "base")
    if alignment == "base":
        return T_map_sensor[:, :3, :3]
    R = torch.eye(3, dtype=T_map_sensor.dtype, device=T_map_sensor.device).repeat(len(T_map_sensor), 1, 1)
    if alignment == "yaw":
        heading = compute_heading(T_map_sensor)
        R[:, :2, 0] = heading
        R[:, 0, 1], R[:, 1, 1] = -heading[:, 1], heading[:, 0]
    return R
