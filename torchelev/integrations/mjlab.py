"""An observation term for mjlab: a map made by ray-cast or depth sensors, in place of the ideal `height_scan`.

    cfg.observations["actor"].terms["height_scan"] = ObservationTermCfg(
        func=MapObservation, params={"sensor_name": "depth_camera", "standing_height": 0.3})

Tried with mjlab 1.6.0, which is not imported here. docs/howto/mjlab.md has the whole config and the results.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, ClassVar

import numpy as np
import torch
from torch import Tensor

from torchelev import HeightScan, depth_to_points
from torchelev.errors import require
from torchelev.frames import transform, transform_matrix
from torchelev.integrations.map_term import MapTerm, Reader
from torchelev.integrations.scene import (
    find,
    own_geoms,
    pinhole,
    require_one_origin,
    require_plain_camera,
    require_unit,
    to_names,
)
from torchelev.integrations.step_map import Cloud, join, to_cloud

if TYPE_CHECKING:
    from jaxtyping import Float


class MapObservation(MapTerm):
    """Read the map of each environment, which its sensors update once per control step.

    Parameters of the term, read once when mjlab builds it:

    - sensor_name: a `RayCastSensor` with a pinhole pattern, or another whose rays start at their frame's origin; a
      `CameraSensor` with "depth"; or a list of these.
    - entity_name: the robot, whose root link is the base.
    - update_every: control steps from one update to the next.
    - standing_height: height of the base over flat ground [m], which an empty map reads.
    - miss_value: what unknown points read [m], as mjlab's `height_scan` has it for rays that miss; None: as `read`
      fills them.
    - feet_sensor_name: a `TerrainHeightSensor` or another `RayCastSensor` whose frames are the feet, for a `read`
      around feet, `HeightScan.feet`.

    Further settings are class attributes: `read`, `map_cfg` and `with_validity` of `MapTerm`. By default it reads
    `HeightScan.mjlab()`, which includes the scale of 1/5 of the rough velocity task: give the term no scale or noise.

    Raises:
        ValueError, TypeError: for a sensor or entity that is missing or does not fit, and for settings out of range.
    """

    read: ClassVar[Reader] = HeightScan.mjlab()

    def __init__(self, cfg: Any, env: Any) -> None:
        sensors = to_names("sensor_name", cfg.params.get("sensor_name"))
        (entity,) = to_names("entity_name", cfg.params.get("entity_name", "robot"))
        num_feet = getattr(type(self).read, "num_feet", 0)
        (feet,) = to_names("feet_sensor_name", cfg.params.get("feet_sensor_name")) if num_feet else (None,)
        source = MjlabSource(sensors, entity, feet)
        source.check(env, num_feet)
        self._set_up(cfg, env, source)

    def __call__(
        self,
        env: Any,
        sensor_name: str | Sequence[str],
        entity_name: str = "robot",
        update_every: int = 1,
        standing_height: float | None = None,
        miss_value: float | None = None,
        feet_sensor_name: str | None = None,
    ) -> Tensor:
        """Return the observation (B, ...), a fresh tensor without NaN."""
        return self._observe(env)


@dataclass(frozen=True)
class MjlabSource:
    """The sensors and the robot in the scene of an mjlab environment."""

    sensor_names: tuple[str, ...]  #: ray-cast and camera sensors, read as one measurement
    entity_name: str  #: the robot
    #: a ray-cast sensor whose frames are the feet; terms that differ in it share their maps
    feet_sensor_name: str | None = field(default=None, compare=False)

    def check(self, env: Any, num_feet: int = 0) -> None:
        """Refuse sensors and entities that are missing or do not fit."""
        robot = find(env.scene, "entity_name", self.entity_name, env.scene.entities)
        for name in self.sensor_names:
            sensor = find(env.scene, "sensor_name", name, env.scene.sensors)
            check = _check_rays if _casts_rays(sensor) else _check_camera
            check(env, name, sensor)
            _require_ground(env, name, sensor, robot)
        if self.feet_sensor_name is not None:
            feet = find(env.scene, "feet_sensor_name", self.feet_sensor_name, env.scene.sensors)
            actual, hint = getattr(feet, "num_frames", 0), "set its frame to one ObjRef for each foot"
            rule = f"{self.feet_sensor_name!r} must have a frame for each of the {num_feet} feet of read"
            require(actual == num_feet, "feet_sensor_name", rule, f"{actual} frames", hint)

    def read_base(self, env: Any) -> Float[Tensor, "B 4 4"]:
        """Return T_map_base; mjlab's quaternions are w x y z."""
        robot = env.scene[self.entity_name].data
        return transform(robot.root_link_pos_w, robot.root_link_quat_w)

    def read_cloud(self, env: Any) -> Cloud:
        """Return the sensors' points of the last control step."""
        return join([self._read_sensor(env, env.scene[name]) for name in self.sensor_names])

    def read_feet(self, env: Any) -> Float[Tensor, "B K 3"]:
        """Return the positions of the feet [m], map frame."""
        return env.scene[self.feet_sensor_name].data.frame_pos_w

    def _read_sensor(self, env: Any, sensor: Any) -> Cloud:
        return _read_rays(sensor) if _casts_rays(sensor) else _read_depth(env, sensor)


def _casts_rays(sensor: Any) -> bool:
    return hasattr(sensor, "num_rays_per_frame")


def _check_rays(env: Any, name: str, sensor: Any) -> None:
    starts, directions = sensor.cfg.pattern.generate_rays(env.sim.mj_model, env.device)
    require_one_origin("sensor_name", name, torch.cat([starts, torch.zeros_like(starts[:1])]))
    require_unit("sensor_name", f"the rays of {name!r} must have unit vectors as directions", directions)


def _check_camera(env: Any, name: str, sensor: Any) -> None:
    kind, hint = type(sensor).__name__, "name a sensor of that kind"
    rule = f"{name!r} must be a RayCastSensor or a CameraSensor"
    require(hasattr(sensor, "camera_idx"), "sensor_name", rule, kind, hint, TypeError)
    types = sensor.cfg.data_types
    rule, hint = f"{name!r} must measure depth", 'set data_types=("depth",) of CameraSensorCfg'
    require("depth" in types, "sensor_name", rule, repr(types), hint)
    rule, hint = f"{name!r} must be a perspective camera given by fovy", "leave out orthographic"
    require(not sensor.cfg.orthographic, "sensor_name", rule, "orthographic=True", hint)
    require_plain_camera("sensor_name", name, env.sim.mj_model, sensor.camera_idx)


def _require_ground(env: Any, name: str, sensor: Any, robot: Any) -> None:
    """Refuse a sensor whose groups of geoms hold the robot's alone."""
    model, cfg = env.sim.mj_model, sensor.cfg
    groups = cfg.include_geom_groups if _casts_rays(sensor) else cfg.enabled_geom_groups
    is_seen = np.isin(model.geom_group, range(6) if groups is None else groups)
    is_own = own_geoms(model, robot.indexing.root_body_id)
    rule, hint = (
        f"{name!r} must see more than the robot itself",
        "give it the group of the terrain's geoms, by default 0",
    )
    require(bool((is_seen & ~is_own).any()), "sensor_name", rule, f"geom groups {groups}", hint)


def _read_rays(sensor: Any) -> Cloud:
    """Return the hits of a ray-cast sensor, each of its frames as a sensor; a miss has distance -1."""
    data, frames = sensor.data, (sensor.num_frames, sensor.num_rays_per_frame)
    hits, distances = data.hit_pos_w.unflatten(1, frames), data.distances.unflatten(1, frames)
    return to_cloud(hits, data.frame_pos_w, distances < 0)


def _read_depth(env: Any, sensor: Any) -> Cloud:
    """Return the points of a depth image along the optical axis, in MuJoCo's camera axes; a miss has depth 0."""
    camera, data = sensor.camera_idx, env.sim.data
    depth = sensor.data.depth.squeeze(-1)
    points = depth_to_points(
        depth, pinhole(env.sim.model.cam_fovy[:, camera], depth.shape[2], depth.shape[1]), frame="opengl"
    )
    T_map_camera = transform_matrix(data.cam_xpos[:, camera], data.cam_xmat[:, camera])
    return Cloud(points[:, None], T_map_camera[:, None])
