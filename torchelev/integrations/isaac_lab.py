"""An observation term for Isaac Lab: a map made by ray casters or depth cameras, in place of `mdp.height_scan`.

    height_scan = ObservationTermCfg(
        func=MapObservation, params={"sensor_cfg": SceneEntityCfg("camera"), "standing_height": 0.5})

Tried in Isaac Lab 3.0.0 with its Newton backend; of 2.3, which needs Isaac Sim, it follows the documentation.
docs/howto/isaac_lab.md has the whole config and the results.
"""

from __future__ import annotations

import importlib.util
from dataclasses import dataclass, field
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
ENCLOSED = 0.5  #: [m] a sensor whose hits all lie within this distance is inside the robot


class MapObservation(MapTerm, ManagerTermBase):
    """Read the map of each environment, which its sensors update once per control step.

    Parameters of the term, read once when Isaac Lab builds it:

    - sensor_cfg: `SceneEntityCfg` of a `RayCasterCamera`, a `Camera` or `TiledCamera` with a depth image, or a
      `RayCaster` whose rays start at one point, such as with a `LidarPatternCfg`; or a list of these.
    - asset_cfg: `SceneEntityCfg` of the robot, whose root link is the base; "robot" if left out.
    - update_every: control steps from one update to the next, for instance the sensor's `update_period` / `step_dt`.
    - standing_height: height of the base over flat ground [m], which an empty map reads.
    - feet_cfg: `SceneEntityCfg` of the robot with the feet as its `body_names`, for a `read` around feet,
      `HeightScan.feet`.

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
        rule, hint = "must count its steps in common_step_counter", "use ManagerBasedRLEnv"
        require(hasattr(env, "common_step_counter"), "env", rule, type(env).__name__, hint, TypeError)
        sensors = to_names("sensor_cfg", cfg.params.get("sensor_cfg"))
        (asset,) = to_names("asset_cfg", cfg.params.get("asset_cfg", "robot"))
        robot = find(env.scene, "asset_cfg", asset, env.scene.keys())
        feet = _find_feet(getattr(type(self).read, "num_feet", 0), cfg.params.get("feet_cfg"), asset)
        source = IsaacLabSource(sensors, asset, _find_order(type(self).quaternions, robot), feet)
        source.check(env, require_cadence(cfg.params.get("update_every", 1)) * env.step_dt)
        self._set_up(cfg, env, source)
        self._sim = env.sim

    def reset(self, env_ids: Any = None) -> None:
        """Forget the maps of environments that restart, whose robots stand at their new places already."""
        super().reset(env_ids)
        # Within a step nothing else moves their links before sensors measure: a camera would see the old place.
        self._sim.forward()

    def __call__(
        self,
        env: Any,
        sensor_cfg: Any,
        asset_cfg: Any = "robot",
        update_every: int = 1,
        standing_height: float | None = None,
        feet_cfg: Any = None,
    ) -> Tensor:
        """Return the observation (B, ...), a fresh tensor without NaN."""
        return self._observe(env)


@dataclass(frozen=True)
class IsaacLabSource:
    """The sensors and the robot in the scene of an Isaac Lab environment."""

    sensor_names: tuple[str, ...]  #: ray casters and cameras, read as one measurement
    asset_name: str  #: the robot
    quaternions: str  #: "wxyz" or "xyzw"
    #: ids of the feet's bodies; terms that differ in them share their maps
    feet: tuple[int, ...] = field(default=(), compare=False)

    def check(self, env: Any, period: float) -> None:
        """Refuse sensors that are missing or do not fit, or that measure less often than every `period` [s]."""
        data = env.scene[self.asset_name].data
        _check_order(self.quaternions, data, self.read_base(env))
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

    def read_feet(self, env: Any) -> Float[Tensor, "B K 3"]:
        """Return the positions of the feet [m], map frame."""
        positions = to_tensor(env.scene[self.asset_name].data.body_link_pos_w)
        return torch.stack([positions[:, body] for body in self.feet], 1)

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


def _find_feet(num_feet: int, feet_cfg: Any, asset: str) -> tuple[int, ...]:
    """Return the ids of the feet's bodies, which the manager has found by their names."""
    if not num_feet:
        return ()
    ids: Any = getattr(feet_cfg, "body_ids", None)
    name = getattr(feet_cfg, "name", None)
    fits = isinstance(ids, list | tuple) and len(ids) == num_feet and name == asset
    rule = f"must name the {num_feet} feet of read among the bodies of {asset!r}"
    hint = f"give SceneEntityCfg({asset!r}, body_names=...) of the feet"
    require(fits, "feet_cfg", rule, f"bodies {ids!r} of {name!r}", hint)
    return tuple(ids)


def _is_camera(sensor: Any) -> bool:
    return hasattr(sensor.cfg, "data_types")


def _find_depth(sensor: Any) -> str:
    """Return the name of the first depth image that a camera provides, "" if there is none."""
    return next((name for name in DEPTHS if name in sensor.cfg.data_types), "")


def _check_order(quaternions: str, data: Any, T_map_base: Float[Tensor, "B 4 4"]) -> None:
    """Refuse an order of quaternions that contradicts what the robot's data say of its heading or of gravity."""
    if not hasattr(data, "heading_w") or not hasattr(data, "projected_gravity_b"):
        return
    R, given = T_map_base[:, :3, :3], to_tensor(data.heading_w)
    heading = torch.stack([given.cos(), given.sin()], -1)
    down = torch.nn.functional.normalize(to_tensor(data.GRAVITY_VEC_W), dim=-1)
    gravity = (R * down[:, :, None]).sum(1)  # in the base frame
    is_upright = (gravity - to_tensor(data.projected_gravity_b).nan_to_num()).abs() < 0.1  # NaN without gravity
    is_ahead = (torch.nn.functional.normalize(R[:, :2, 0], dim=-1) - heading).abs() < 0.1
    rule = "must be the order in which the robot's data give them, with their heading_w and projected_gravity_b"
    require(bool(is_upright.all() & is_ahead.all()), "quaternions", rule, repr(quaternions), "leave it None")


def _check_camera(name: str, sensor: Any) -> None:
    cfg = sensor.cfg
    rule, hint = f"{name!r} must have one of {', '.join(DEPTHS)}", 'set data_types=["distance_to_image_plane"]'
    require(_find_depth(sensor) != "", "sensor_cfg", rule, repr(cfg.data_types), hint)
    parts = (cfg, getattr(cfg, "renderer_cfg", None))  # Isaac Lab 3 moves the setting of a rendered camera
    clips = any(getattr(part, "depth_clipping_behavior", "none") == "max" for part in parts)
    rule, hint = f"{name!r} must not report misses as its maximum distance", 'set depth_clipping_behavior="none"'
    require(not clips, "sensor_cfg", rule, "depth_clipping_behavior='max'", hint)
    rule, hint = f"{name!r} must report its current pose", "set update_latest_camera_pose=True"
    follows = getattr(cfg, "update_latest_camera_pose", True)
    require(follows, "sensor_cfg", rule, f"update_latest_camera_pose={follows!r}", hint)


def _check_rays(name: str, sensor: Any) -> None:
    rule, hint = f"{name!r} must be a RayCaster or a camera", "name a sensor of that kind"
    kind = type(sensor).__name__
    require(hasattr(sensor, "ray_starts"), "sensor_cfg", rule, kind, hint, TypeError)
    require_one_origin("sensor_cfg", name, to_tensor(sensor.ray_starts))
    if getattr(sensor.cfg, "global_world_only", True) is False:
        _check_surroundings(name, sensor)


def _check_surroundings(name: str, sensor: Any) -> None:
    """Refuse a ray caster whose rays all end close by, also above it: they start inside the robot, which Newton shows.

    Measures once.
    """
    data = sensor.data
    offset = to_tensor(data.ray_hits_w) - to_tensor(data.pos_w)[:, None]
    is_enclosed = (torch.linalg.vector_norm(offset, dim=-1) < ENCLOSED).all() & (offset[..., 2] > 0).any()
    rule = f"{name!r} must see more than the robot that carries it"
    hint = "set global_world_only=True, or an offset that places the sensor outside of the robot's shapes"
    require(not bool(is_enclosed), "sensor_cfg", rule, f"hits within {ENCLOSED} m all around", hint)


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
