"""The perception of TerrainNav's robots: their map, the true ground with white noise, or none.

Each sight returns an image (B, 4, n, n) of the same crop in the base's yaw frame: elevation and upper bound relative to
the ground under the base [m], validity, traversability; the channels of `ceilings.py` follow. Unknown pixels are 0 in
all four, but for the elevation of `MapSight`, which `SightConfig.fill` fills. `sense` takes a measurement and draws all
random numbers; `image` only reads.
"""

from __future__ import annotations

from collections.abc import Iterator

import torch
from torch import Tensor, nn

from envs.terrain_nav.ceilings import count_channels, make_reader
from envs.terrain_nav.config import TerrainNavConfig
from envs.terrain_nav.course import RatedCourse
from torchelev import ElevationMap, ElevationMapConfig, GridConfig, HeightScan, LevelsConfig, MapImage
from torchelev.errors import require
from torchelev.sim import DepthCamera, MountedSensor, PoseErrors, SensorErrors, mount_on_rim, preset
from torchelev.sim.terrains.heightfield import heights_of

LAYERS = ("elevation", "upper_bound", "validity", "traversability")


def _make_crop(cfg: TerrainNavConfig) -> MapImage:
    """Return the crop of the map that policies read."""
    sight = cfg.sight
    return MapImage(
        length_x=sight.crop_length,
        length_y=sight.crop_length,
        resolution=sight.crop_resolution,
        offset=(sight.crop_ahead, 0.0),
        layers=LAYERS,
        nominal_height=cfg.robot.body_height,
    )


def _make_filled_scan(cfg: TerrainNavConfig, crop: MapImage) -> HeightScan | None:
    """Return the scan that reads the crop's elevation and fills it; None for "base", where the crop reads 0 already."""
    if cfg.sight.fill == "base":
        return None
    points = crop.xy(torch.eye(4)[None])[0]
    # A scan counts downwards from the nominal height, an image upwards.
    return HeightScan.points(points, nominal_height=cfg.robot.body_height, scale=-1.0, fill=cfg.sight.fill)


class BlindSight(nn.Module):
    """No sight: an image of unknown ground. The other sights derive from it."""

    def __init__(self, cfg: TerrainNavConfig, course: RatedCourse, num_envs: int, compiled: bool = False) -> None:
        super().__init__()
        self.cfg, self.course, self.num_envs, self.crop = cfg, course, num_envs, _make_crop(cfg)
        self.generator = torch.Generator(course.field.device)

    def reset(self, mask: Tensor) -> None:
        """Begin new episodes in the environments of `mask` (B,) bool."""

    def sense(self, T_map_base: Tensor, tile_ids: Tensor, mask: Tensor) -> None:
        """Take a measurement from the poses of the robots, in the environments of `mask` (B,) bool."""

    def image(self, T_map_base: Tensor, tile_ids: Tensor) -> Tensor:
        """Return the image (B, 4, n, n)."""
        C, *size = self.crop.shape
        return torch.zeros(self.num_envs, C + count_channels(self.cfg), *size, device=self.course.field.device)

    def get_extra_state(self) -> dict[str, Tensor]:
        """Return the state of the random number generator."""
        return {"generator": self.generator.get_state()}

    def set_extra_state(self, state: dict[str, Tensor]) -> None:
        """Set the state of the random number generator."""
        self.generator.set_state(state["generator"].cpu())


class TruthSight(BlindSight):
    """The true ground, its heights with uniform noise drawn at each measurement, its traversability without noise.

    Its ceilings have no noise.
    """

    noise: Tensor

    def __init__(
        self,
        cfg: TerrainNavConfig,
        course: RatedCourse,
        num_envs: int,
        compiled: bool = False,
        noise: float | None = None,
        ceilings: str | None = None,
    ) -> None:
        super().__init__(cfg, course, num_envs)
        self.shown = cfg.sight.ceilings if ceilings is None else ceilings
        rule, hint = "must be none or scan for the truth", "use scan, or perception map"
        require(self.shown in ("none", "scan"), "sight.ceilings", rule, repr(self.shown), hint)
        self.amplitude = cfg.sight.truth_noise if noise is None else noise
        shape = self.crop.shape[1:]
        self.register_buffer("noise", torch.zeros(num_envs, *shape, device=course.field.device))

    def sense(self, T_map_base: Tensor, tile_ids: Tensor, mask: Tensor) -> None:
        """Draw new noise."""
        if self.amplitude > 0:
            u = torch.rand(self.noise.shape, generator=self.generator, device=self.noise.device)
            self.noise.copy_(torch.where(mask[:, None, None], (2 * u - 1) * self.amplitude, self.noise))

    def image(self, T_map_base: Tensor, tile_ids: Tensor) -> Tensor:
        """Return the image of the ground: all cells are known, and the upper bound equals the elevation."""
        xy = self.crop.xy(T_map_base)
        ground = T_map_base[:, 2, 3] - self.cfg.robot.body_height
        shape = self.noise.shape
        height, traversability = heights_of((self.course.field, self.course.traversability), tile_ids, xy)
        elevation = (height - ground[:, None]).view(shape) + self.noise
        known = torch.ones_like(elevation)
        image = torch.stack([elevation, elevation, known, traversability.view(shape)], 1)
        if self.shown == "none":
            return image
        ceiling = (self._ceiling(tile_ids, xy) - T_map_base[:, 2, 3, None]).clamp(max=self.cfg.sight.no_ceiling)
        return torch.cat([image, torch.stack([ceiling.view(shape), known], 1)], 1)

    def _ceiling(self, tile_ids: Tensor, xy: Tensor) -> Tensor:
        """Return the true ceiling (B, M) [m] at places, inf where nothing hangs."""
        if self.course.ceilings is None:
            return torch.full_like(xy[..., 0], torch.inf)
        return self.course.ceilings.height(tile_ids, xy)


def _mountings(cfg: TerrainNavConfig) -> list[Tensor]:
    """Return T_base_sensor (4, 4) of the cameras on the rim of the robot's body."""
    # Headings are rounded to float32, on which the recorded rollout in tests/answers.npz.xz depends.
    yaws_deg = torch.tensor(cfg.sight.camera_yaws_deg).deg2rad().double().rad2deg().tolist()
    body, pitch_deg = cfg.robot, cfg.sight.camera_pitch_deg
    return [mount_on_rim(body.length, body.width, yaw_deg, pitch_deg).float() for yaw_deg in yaws_deg]


class MapSight(BlindSight):
    """An elevation map built from simulated depth cameras, at estimated poses that drift."""

    T_estimated: Tensor

    def __init__(self, cfg: TerrainNavConfig, course: RatedCourse, num_envs: int, compiled: bool = False) -> None:
        super().__init__(cfg, course, num_envs)
        sight, device = cfg.sight, course.field.device
        grid = GridConfig(resolution=sight.resolution, length_x=sight.window, length_y=sight.window)
        # Half the height of the robot: the map then tells spaces that it does not fit into from walls.
        levels = LevelsConfig(min_gap=cfg.robot.top / 2) if sight.ceilings != "none" else None
        map_cfg = ElevationMapConfig(grid=grid, levels=levels)
        self.emap = ElevationMap(map_cfg, num_envs, device)
        self.read_ceilings = make_reader(cfg, self.crop)
        self.filled_scan = _make_filled_scan(cfg, self.crop)
        if compiled:
            self.emap.compile()
        camera = DepthCamera(*sight.camera_pixels, *sight.camera_fov_deg, max_range=sight.max_range)
        self.cameras = [MountedSensor(camera, T.to(device)) for T in _mountings(cfg)]
        sensor, odometry = preset(sight.sensor_errors).sensor, preset(sight.pose_errors).pose
        self.sensor_errors = nn.ModuleList(SensorErrors(sensor, num_envs, device) for _ in self.cameras)
        self.pose_errors = PoseErrors(odometry, num_envs, device)
        self.register_buffer("T_estimated", torch.eye(4, device=device).repeat(num_envs, 1, 1))

    def reset(self, mask: Tensor) -> None:
        """Clear the maps and draw new errors."""
        self.emap.reset(mask=mask)
        for errors in (*self.sensor_errors, self.pose_errors):
            errors.reset(mask=mask)

    def sense(self, T_map_base: Tensor, tile_ids: Tensor, mask: Tensor) -> None:
        """Cast rays from the true poses, and map the points at the estimated ones."""
        dt = torch.where(mask, self.cfg.dt, 0.0)
        estimated = self.pose_errors(T_map_base, dt)
        self.T_estimated.copy_(torch.where(mask[:, None, None], estimated, self.T_estimated))
        points, T_map_sensor = self.look(T_map_base, tile_ids)
        points.masked_fill_(~mask[:, None, None, None], torch.nan)
        self.emap.update(points, T_map_sensor, self.T_estimated, dt)

    def look(self, T_map_base: Tensor, tile_ids: Tensor) -> tuple[Tensor, Tensor]:
        """Return the points of the K cameras (B, K, M, 3), sensor frame, and their estimated poses (B, K, 4, 4)."""
        width, height = self.cfg.sight.camera_pixels
        K, clouds, structures = len(self.cameras), [], self.course.structures
        # All at once, so that a tile is cast at by all cameras while it is in the caches: their rays are the same.
        seen = self.cameras[0](
            self.course.field,
            tile_ids.repeat(K),
            T_map_base.repeat(K, 1, 1),
            None if structures is None else structures.boxes(tile_ids.repeat(K)),
            T_base_sensor=torch.cat([camera.T_base_sensor @ errors.mounting() for camera, errors in self._sensors()]),
        )
        for points, (camera, errors) in zip(seen.chunk(K), self._sensors(), strict=True):
            clouds.append(errors(points, camera.T_map_sensor(self.T_estimated), image_shape=(height, width)))
        poses = [cloud.T_map_sensor for cloud in clouds if cloud.T_map_sensor is not None]
        return torch.stack([cloud.points for cloud in clouds], 1), torch.stack(poses, 1)

    def _sensors(self) -> Iterator[tuple[MountedSensor, SensorErrors]]:
        """Yield each camera and its errors."""
        for camera, errors in zip(self.cameras, self.sensor_errors, strict=True):
            assert isinstance(errors, SensorErrors)
            yield camera, errors

    def image(self, T_map_base: Tensor, tile_ids: Tensor) -> Tensor:
        """Return the image of the map, its elevation filled where it is unknown."""
        image = self.crop(self.emap, self.T_estimated)
        if self.filled_scan is not None:
            elevation, _ = self.filled_scan(self.emap, self.T_estimated)
            image = torch.cat([elevation.view_as(image[:, :1]), image[:, 1:]], 1)
        if self.read_ceilings is not None:
            image = torch.cat([image, self.read_ceilings(self.emap, self.T_estimated)], 1)
        return image


SIGHTS: dict[str, type[BlindSight]] = {"map": MapSight, "truth": TruthSight, "blind": BlindSight}
