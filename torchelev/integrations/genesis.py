"""Maps of the environments of a Genesis scene, fed by its lidars and depth cameras.

    maps = GenesisMaps(robot.get_link("base"), [lidar, camera], cfg)
    maps.update(dt=scene.dt)
    values, valid = HeightScan.isaac_lab()(maps.emap, maps.T_map_base)

Run with Genesis 1.4.5, which is not imported here: docs/howto/genesis.md.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import torch
from torch import Tensor

from torchelev import ElevationMap, ElevationMapConfig
from torchelev.errors import require
from torchelev.frames import transform
from torchelev.integrations.step_map import Cloud, join

if TYPE_CHECKING:
    from jaxtyping import Bool, Float, Int


class GenesisMaps:
    """One map for each environment of a scene that is built.

    Args:
        base: link that the maps' windows follow: x forward, z up.
        sensors: `Lidar` or `DepthCamera` sensors on links of the robot, read as one measurement.
        cfg: config of the maps.

    Raises:
        ValueError: there is no sensor, one is on no link, or returns no points or points in the world's frame.
    """

    def __init__(self, base: Any, sensors: Sequence[Any], cfg: ElevationMapConfig | None = None) -> None:
        require(len(sensors) > 0, "sensors", "must not be empty", "none", "give scene.add_sensor(...)")
        for sensor in sensors:
            options = sensor._options
            hint = "give it entity_idx and link_idx_local, and build the scene first"
            require(sensor._link is not None, "sensors", "must be on a link of a scene that is built", "none", hint)
            rule, hint = "must return points in the sensor's frame", "leave return_points and return_world_frame out"
            given = f"return_points={options.return_points}, return_world_frame={options.return_world_frame}"
            require(options.return_points and not options.return_world_frame, "sensors", rule, given, hint)
        self.T_map_base = _pose_of(base)
        offsets = (self.T_map_base.new_tensor(sensor._options.pos_offset) for sensor in sensors)
        self._base, self._sensors = base, tuple(zip(sensors, offsets, strict=True))
        self.emap = ElevationMap(cfg, num_envs=len(self.T_map_base), device=self.T_map_base.device)

    def update(self, dt: float | Float[Tensor, "B"]) -> None:
        """Fuse what the sensors saw in the last step of the scene.

        Args:
            dt: time since the last update [s]; 0 where an environment was just reset.
        """
        self.T_map_base = _pose_of(self._base)
        cloud = join([_read(sensor, offset) for sensor, offset in self._sensors])
        self.emap.update(cloud.points, cloud.T_map_sensor, self.T_map_base, dt)

    def reset(self, env_ids: Int[Tensor, "K"] | None = None, *, mask: Bool[Tensor, "B"] | None = None) -> None:
        """Forget the maps of environments that restart, by number or by mask; without both, of all."""
        self.emap.reset(env_ids, mask=mask)


def _pose_of(link: Any) -> Float[Tensor, "B 4 4"]:
    """Return the pose of a link; Genesis's quaternions are w x y z, and scenes without environments have no batch."""
    return transform(link.get_pos().reshape(-1, 3).double(), link.get_quat().reshape(-1, 4).double())


def _read(sensor: Any, offset: Float[Tensor, "3"]) -> Cloud:
    """Return the points of a sensor: from its place, along the axes of its link; (0, 0, 0) where nothing was hit."""
    found, T = sensor.read(), _pose_of(sensor._link)
    B = len(T)
    points, distance = found.points.reshape(B, -1, 3), found.distances.reshape(B, -1)
    is_miss = distance == sensor._options.no_hit_value
    T_map_sensor = T.clone()
    T_map_sensor[:, :3, 3] += T[:, :3, :3] @ offset
    return Cloud(points.masked_fill(is_miss[..., None], torch.nan)[:, None], T_map_sensor[:, None])
