"""The quadruped's perception of the ground: its map, the true heights with noise, or none.

Each sight returns the same two observations: "height_scan" (B, 187), the base above the ground around it, and "feet"
(B, 4 * P), each foot above the rings of ground around it.
"""

from __future__ import annotations

import dataclasses
from typing import Any, NamedTuple

import torch
from torch import Tensor, nn

from envs.quadruped.config import SENSORS, QuadrupedConfig
from envs.quadruped.height_noise import HeightNoise
from envs.quadruped.kinematics import LINKS
from envs.quadruped.physics import ROBOT
from torchelev import ElevationMap, ElevationMapConfig, GridConfig, HeightScan, SensorConfig
from torchelev.io.robot_model import read_body
from torchelev.observations.patterns import compute_heading
from torchelev.sim import DepthCamera, HeightField, Lidar, MountedSensor, SensorErrorConfig, SensorErrors, mount, preset

NUM_FEET = 4
_CAMERA_WIDTH = 848  # pixels of the camera that the preset "depth_camera" imitates


def make_scans(cfg: QuadrupedConfig) -> tuple[HeightScan, HeightScan]:
    """Return the scan around the base, and that around the feet."""
    height = cfg.gait.body_height
    base = HeightScan.isaac_lab(nominal_height=height, clip=1.0, fill=cfg.sight.fill)
    return base, HeightScan.feet(rings=cfg.sight.rings, reach=0.5, clip=1.0, fill=cfg.sight.fill)


class View(NamedTuple):
    """The poses from which B robots see, in the frame of their tile."""

    T_map_base: Tensor  #: (B, 4, 4) true poses
    T_estimated: Tensor  #: (B, 4, 4) poses that the robots believe in
    T_base_links: Tensor  #: (B, 13, 4, 4) true poses of the links
    T_base_links_measured: Tensor  #: (B, 13, 4, 4) the same from the joint encoders
    feet: Tensor  #: (B, 4, 3) [m] base frame, from the joint encoders
    tile_ids: Tensor  #: (B,)

    def feet_in(self, T_map_base: Tensor) -> Tensor:
        """Return the feet (B, 4, 3) [m] in the frame of a pose."""
        return self.feet @ T_map_base[:, :3, :3].mT + T_map_base[:, None, :3, 3]


class Seen(NamedTuple):
    """The points of S sensors of N rays."""

    points: Tensor  #: (B, S, N, 3) [m] sensor frame
    ideal: Tensor  #: (B, S, N, 3) [m] the same without errors
    on_body: Tensor  #: (B, S, N) bool, whether a ray hit the robot itself
    T_map_sensor: Tensor  #: (B, S, 4, 4) estimated poses


class BlindSight(nn.Module):
    """No sight: all values are 0. The other sights derive from it."""

    def __init__(self, cfg: QuadrupedConfig, field: HeightField, num_envs: int, compiled: bool = False) -> None:
        super().__init__()
        self.cfg, self.field, self.num_envs = cfg, field, num_envs
        self.scan, self.foot_scan = make_scans(cfg)

    def reset(self, mask: Tensor) -> None:
        """Begin new episodes in the environments of `mask` (B,) bool."""

    def sense(self, view: View, dt: Tensor) -> None:
        """Take a measurement; `dt` (B,) [s] is the time since the last one, 0 in new episodes."""

    def read(self, view: View) -> dict[str, Tensor]:
        """Return the observations "height_scan" (B, 187) and "feet" (B, 4 * P)."""
        sizes = {"height_scan": self.scan.num_points, "feet": self.foot_scan.num_points}
        return {name: torch.zeros(self.num_envs, n, device=self.field.device) for name, n in sizes.items()}


class TruthSight(BlindSight):
    """The true heights, with or without noise."""

    def __init__(
        self,
        cfg: QuadrupedConfig,
        field: HeightField,
        num_envs: int,
        compiled: bool = False,
        noisy: bool | None = None,
    ) -> None:
        super().__init__(cfg, field, num_envs)
        noisy = cfg.sight.truth_noise if noisy is None else noisy
        self.noise = HeightNoise(num_envs, 1 + NUM_FEET, field.device) if noisy else None

    def reset(self, mask: Tensor) -> None:
        """Draw new offsets."""
        if self.noise is not None:
            self.noise.reset(mask)

    def read(self, view: View) -> dict[str, Tensor]:
        """Return the true heights at the points of the scans."""
        T, feet = view.T_map_base, view.feet_in(view.T_map_base)
        scan = self._heights(self.scan, T, T[:, None, :3, 3], view.tile_ids, 0)
        rings = self._heights(self.foot_scan, T, feet, view.tile_ids, 1)
        return {"height_scan": scan, "feet": rings}

    def _heights(self, scan: HeightScan, T: Tensor, origins: Tensor, tile_ids: Tensor, first: int) -> Tensor:
        """Return z - h - nominal_height, clipped, at the pattern around each of K origins (B, K, 3) [m]."""
        forward = compute_heading(T)
        left = torch.stack([-forward[:, 1], forward[:, 0]], -1)
        points = scan.placement.on(T.device, T.dtype)
        offset = points[:, :1] * forward[:, None] + points[:, 1:] * left[:, None]
        values = []
        for k, origin in enumerate(origins.unbind(1)):
            xy = origin[:, None, :2] + offset
            xy = xy if self.noise is None else self.noise.shift(xy, first + k)
            height = self.field.height(tile_ids, xy)
            height = height if self.noise is None else self.noise.disturb(height, first + k)
            values.append(origin[:, 2:] - height - scan.nominal_height)
        clip = torch.inf if scan.clip is None else scan.clip
        return torch.cat(values, -1).clamp(-clip, clip)


class MapSight(BlindSight):
    """An elevation map built from simulated sensors, at estimated poses that drift."""

    def __init__(self, cfg: QuadrupedConfig, field: HeightField, num_envs: int, compiled: bool = False) -> None:
        super().__init__(cfg, field, num_envs)
        sight, device = cfg.sight, field.device
        grid = GridConfig(resolution=sight.resolution, length_x=sight.window, length_y=sight.window)
        self.body = read_body(ROBOT)
        self.link_ids = [LINKS.index(link) for link in self.body.links]
        config = ElevationMapConfig(grid=grid, sensor=SensorConfig(body=self.body))
        self.emap = ElevationMap(config, num_envs, device)
        if compiled:
            self.emap.compile()
        self.sensors = make_sensors(cfg)
        errors = sensor_errors(cfg)
        self.sensor_errors = nn.ModuleList(SensorErrors(errors, num_envs, device) for _ in self.sensors)

    def reset(self, mask: Tensor) -> None:
        """Clear the maps and draw new errors."""
        self.emap.reset(mask=mask)
        for errors in self.sensor_errors:
            assert isinstance(errors, SensorErrors)
            errors.reset(mask=mask)

    def sense(self, view: View, dt: Tensor) -> None:
        """Cast rays from the true poses, and map the points at the estimated ones."""
        seen = self.look(view)
        links = view.T_base_links_measured[:, self.link_ids]
        self.emap.update(seen.points, seen.T_map_sensor, view.T_estimated, dt, T_base_links=links)

    def look(self, view: View) -> Seen:
        """Return what the S sensors see, with their errors."""
        parts: list[tuple[Tensor, Tensor, Tensor, Tensor]] = []
        links = view.T_base_links[:, self.link_ids]
        for sensor, errors in zip(self.sensors, self.sensor_errors, strict=True):
            assert isinstance(errors, SensorErrors)
            mounting = sensor.T_base_sensor.to(self.field.device) @ errors.mounting().to(sensor.T_base_sensor.dtype)
            at: dict[str, Any] = {"T_base_sensor": mounting, "body": self.body, "T_base_links": links}
            ideal = sensor.view(self.field, view.tile_ids, view.T_map_base, **at)
            cloud = errors(ideal.points, sensor.T_map_sensor(view.T_estimated), image_shape=self._image_shape())
            parts.append((cloud.points, ideal.points, ideal.on_body, cloud.T_map_sensor))
        return Seen(*(torch.stack(part, 1) for part in zip(*parts, strict=True)))

    def _image_shape(self) -> tuple[int, int] | None:
        width, height = self.cfg.sight.camera_pixels
        return (height, width) if self.cfg.sight.sensors == "depth_cameras" else None

    def read(self, view: View) -> dict[str, Tensor]:
        """Return the heights of the map."""
        T = view.T_estimated
        scan, _ = self.scan(self.emap, T)
        feet, _ = self.foot_scan(self.emap, T, view.feet_in(T))
        return {"height_scan": scan, "feet": feet}


def make_sensors(cfg: QuadrupedConfig) -> list[MountedSensor]:
    """Return the depth cameras at both ends of the base, or the lidar on its back."""
    sight = cfg.sight
    if sight.sensors == "lidar":
        lidar = Lidar(rings=16, azimuths=60, max_range=sight.max_range)
        return [MountedSensor(lidar, mount(0.0, z=0.12).float(), min_range=0.1)]
    camera = DepthCamera(*sight.camera_pixels, *sight.camera_fov_deg, max_range=sight.max_range)
    places = ((0.2, 0.0), (-0.2, 180.0))
    mountings = [mount(sight.camera_pitch_deg, x, 0.04, yaw_deg=yaw_deg).float() for x, yaw_deg in places]
    return [MountedSensor(camera, T, min_range=0.05) for T in mountings]


def sensor_errors(cfg: QuadrupedConfig) -> SensorErrorConfig:
    """Return the errors of the sensors' preset; of cameras, for images of few pixels, picked from those of a whole one.

    A pixel that straddles an edge measures a depth between its two sides. Of picked pixels, few do: as many fewer as
    there are fewer pixels. A lidar is simulated with all its points. Latency is left out: a robot looks up its joint
    angles by the stamp of a scan, so that a late scan comes with the poses of its own moment.
    """
    sight = cfg.sight
    errors = preset(sight.sensor_errors or SENSORS[sight.sensors]).sensor
    assert isinstance(errors, SensorErrorConfig)
    flying = errors.flying if isinstance(errors.flying, tuple) else (errors.flying, errors.flying)
    picked = sight.camera_pixels[0] / _CAMERA_WIDTH if sight.sensors == "depth_cameras" else 1.0
    position, rotation_deg = sight.mounting_error
    return dataclasses.replace(
        errors,
        latency=0,
        flying=(flying[0] * picked, flying[1] * picked),
        mounting_position=position,
        mounting_rotation_deg=rotation_deg,
    )


SIGHTS: dict[str, type[BlindSight]] = {"map": MapSight, "truth": TruthSight, "blind": BlindSight}
