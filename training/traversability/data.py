"""What a learned head sees and should say: maps of simulated sensors on walking robots, and the labels of their cells.

The map's frame is turned and shifted against the tile's, and the robot's estimate drifts in it. A map is for the robot
that it follows, so a cell's true place is the one that lies to the true base as the cell lies to the estimated one.
"""

from __future__ import annotations

import dataclasses
import math
import os
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor
from tqdm import tqdm

from torchelev import ElevationMap, ElevationMapConfig, GridConfig
from torchelev.errors import require, require_positive
from torchelev.robot import RobotConfig
from torchelev.sim import HeightField, PoseErrors, preset
from torchelev.sim.trajectories import pose
from training.traversability.labels import stand
from training.traversability.sight import Sight
from training.traversability.terrain import KINDS, LENGTH, LOOK_INTERVAL, Footing, draw_robot, make_tiles, walks

if TYPE_CHECKING:
    from jaxtyping import Bool, Float

VERSION = 1  # of maps and labels; raise it where their making changes, so that kept ones are refused
RATED_REACH = 0.3  # [m] around known cells in which unknown ones are rated
RESOLUTIONS = (0.02, 0.1)  # [m]
SPLITS = {"train": 0, "held_out": 1, "unseen": 2}


@dataclass(frozen=True, kw_only=True)
class DataConfig:
    """How maps are made."""

    num_maps: int = 2  # of a batch, which shares robot, resolution and sensors
    window: float = 4.0  # [m] side of a map, to whole cells
    looks: tuple[int, int] = (10, 20)  # fewest and most
    headings: int = 8  # of a label
    camera_pixels: tuple[int, int] = (64, 48)  # width, height
    lidar_rays: tuple[int, int] = (32, 256)  # rings, azimuths
    robot: RobotConfig | None = None  # None: each batch draws its own

    def __post_init__(self) -> None:
        require_positive(window=self.window)
        positive = self.num_maps >= 1 and self.headings >= 1 and 1 <= self.looks[0] <= self.looks[1]
        came = (self.num_maps, self.headings, self.looks)
        require(positive, "num_maps, headings, looks", "must be at least 1", came, "see their defaults")


class MappedTerrain(NamedTuple):
    """B maps of one resolution, for one robot, and the truth of their cells."""

    elevation: Float[Tensor, "B H W"]  # [m]
    validity: Bool[Tensor, "B H W"]
    variance: Float[Tensor, "B H W"]  # [m^2]
    upper_bound: Float[Tensor, "B H W"]  # [m]
    bounded: Bool[Tensor, "B H W"]
    label: Float[Tensor, "B H W"]  # share of the headings at which the robot stands there; 0 where not rated
    rated: Bool[Tensor, "B H W"]  # cells that count, see `rated_cells`
    resolution: float  # [m]
    robot: RobotConfig
    kinds: tuple[str, ...]  # of the terrain, one for each map

    @property
    def maps(self) -> tuple[Tensor, Tensor, Tensor, Tensor, Tensor]:
        """What a head sees, in the order of its arguments."""
        return self.elevation, self.validity, self.variance, self.upper_bound, self.bounded


def make_batch(
    seed: int | Sequence[int],
    cfg: DataConfig | None = None,
    kinds: Sequence[str] = KINDS,
    resolution: float | None = None,
) -> MappedTerrain:
    """Make maps of ground of random kinds; the same seed makes the same maps.

    Args:
        seed: of everything that chance decides.
        cfg: how many maps, of what.
        kinds: to draw the ground from.
        resolution: of the maps [m]; None: drawn from 2 to 10 cm, evenly in its logarithm, in whole millimetres.
    """
    cfg = cfg or DataConfig()
    rng = np.random.default_rng(seed)
    names = tuple(str(name) for name in rng.choice(list(kinds), cfg.num_maps))
    robot = draw_robot(rng) if cfg.robot is None else cfg.robot
    resolution = resolution or round(math.exp(rng.uniform(*np.log(RESOLUTIONS))), 3)
    field = make_tiles(names, rng)
    emap, T_tile_map = walk_and_map(field, robot, resolution, cfg, rng)
    return label_cells(emap, T_tile_map, field, robot, cfg.headings, names)


class Look(NamedTuple):
    """What the robots of a batch see at one time."""

    points: Float[Tensor, "B S N 3"]  # [m] sensor frame
    T_map_sensor: Float[Tensor, "B S 4 4"]  # as estimated
    T_map_base: Float[Tensor, "B 4 4"]  # as estimated
    T_tile_base: Float[Tensor, "B 4 4"]  # the truth


def walk_and_look(field: HeightField, robot: RobotConfig, cfg: DataConfig, rng: np.random.Generator) -> Iterator[Look]:
    """Walk over every tile, and yield what simulated sensors with errors see."""
    num, looks = field.num_tiles, int(rng.integers(cfg.looks[0], cfg.looks[1], endpoint=True))
    path = walks(Footing(field, robot), num, looks, rng)
    sight = Sight(robot, num, cfg.camera_pixels, cfg.lidar_rays, rng)
    odometry = PoseErrors(preset("leg_odometry").pose, num, seed=int(rng.integers(2**31)))
    T_map_tile = _map_frames(num, rng)
    for T_tile_base in path:
        T_map_base = T_map_tile @ odometry(T_tile_base, LOOK_INTERVAL)
        points, T_map_sensor = sight.look(field, T_tile_base, T_map_base)
        yield Look(points, T_map_sensor, T_map_base, T_tile_base)


def walk_and_map(
    field: HeightField, robot: RobotConfig, resolution: float, cfg: DataConfig, rng: np.random.Generator
) -> tuple[ElevationMap, Float[Tensor, "B 4 4"]]:
    """Walk over every tile and map it; return the maps and T_tile_map (B, 4, 4), as at the last look."""
    emap = blank_map(resolution, cfg.window, field.num_tiles)
    for look in walk_and_look(field, robot, cfg, rng):
        emap.update(look.points, look.T_map_sensor, look.T_map_base, LOOK_INTERVAL)
    return emap, look.T_tile_base @ torch.linalg.inv(look.T_map_base)


def map_config(resolution: float, window: float) -> ElevationMapConfig:
    """Return the configuration of maps of about `window` [m], without a head of their own."""
    length = round(window / resolution) * resolution
    grid = GridConfig(resolution=resolution, length_x=length, length_y=length)
    return ElevationMapConfig(grid=grid, traversability=None)


def blank_map(resolution: float, window: float, num_maps: int) -> ElevationMap:
    """Return maps that know nothing."""
    return ElevationMap(map_config(resolution, window), num_maps)


def _map_frames(num: int, rng: np.random.Generator) -> Tensor:
    """Draw T_map_tile (num, 4, 4): turned anyhow, so that edges lie anyhow to the cells, and elsewhere."""
    place = torch.from_numpy(rng.uniform(-20, 20, (num, 3)))
    return pose(place, torch.from_numpy(rng.uniform(-math.pi, math.pi, num)))


def label_cells(
    emap: ElevationMap,
    T_tile_map: Float[Tensor, "B 4 4"],
    field: HeightField,
    robot: RobotConfig,
    headings: int,
    kinds: tuple[str, ...],
) -> MappedTerrain:
    """Read maps, and label their rated cells by where the robot stands on the true ground."""
    grid, state = emap.cfg.grid, emap.state
    xy = tile_places(emap, T_tile_map)
    rated = rated_cells(state.validity, state.bounded, grid.resolution) & (xy.abs().amax(-1) <= LENGTH / 2)
    label = torch.zeros_like(state.elevation)
    for b in range(len(label)):  # the number of rated cells differs
        places = xy[b][rated[b]].float()
        stands = stand(field, torch.tensor([b]), places[None], [robot], headings)
        label[b][rated[b]] = stands[0].float().mean(-1)
    return MappedTerrain(
        elevation=state.elevation.clone(),
        validity=state.validity.clone(),
        variance=state.variance.clone(),
        upper_bound=state.upper_bound.clone(),
        bounded=state.bounded.clone(),
        label=label,
        rated=rated,
        resolution=grid.resolution,
        robot=robot,
        kinds=kinds,
    )


def tile_places(emap: ElevationMap, T_tile_map: Float[Tensor, "B 4 4"]) -> Float[Tensor, "B H W 2"]:
    """Return the true places [m] of the cells' centres in the tiles' frames, float64."""
    turned = torch.einsum("bkl,bijl->bijk", T_tile_map[:, :2, :2], emap.cell_centers())
    return turned + T_tile_map[:, None, None, :2, 3]


def rated_cells(validity: Tensor, bounded: Tensor, resolution: float) -> Bool[Tensor, "B H W"]:
    """Return the cells that count in training and metrics: known, bounded, or within 0.3 m of known along both axes."""
    reach = round(RATED_REACH / resolution)
    near = F.max_pool2d(validity.float()[:, None], 2 * reach + 1, 1, reach)[:, 0] > 0
    return near | bounded


# On disk ----------------------------------------------------------------------------------------------------------


def batch_seed(split: str, seed: int, index: int) -> list[int]:
    """Return the seed of a batch: splits, data sets and batches are independent of each other."""
    return [SPLITS[split], seed, index]


def data_set(
    folder: Path,
    split: str,
    count: int,
    seed: int,
    cfg: DataConfig,
    kinds: Sequence[str] = KINDS,
    resolution: float | None = None,
) -> list[MappedTerrain]:
    """Return the batches 0 .. count - 1 of a data set: those that `folder` has, and the rest made and kept there.

    Raises ValueError for a file of other settings.
    """
    folder.mkdir(parents=True, exist_ok=True)
    settings = dataclasses.asdict(cfg) | {"kinds": list(kinds), "resolution": resolution, "version": VERSION}
    name = f"{split}-{seed}" + (f"-{1000 * resolution:g}mm" if resolution else "")
    batches = []
    for index in tqdm(range(count), desc=f"data {name}", unit="batch"):
        path = folder / f"{name}-{index:04d}.pt"
        if not path.exists():
            batch = make_batch(batch_seed(split, seed, index), cfg, kinds, resolution)
            save_atomically({"settings": settings, **batch._asdict(), "robot": dataclasses.asdict(batch.robot)}, path)
        batches.append(_load(path, settings))
    return batches


def save_atomically(values: dict[str, Any], path: Path) -> None:
    """Write a file by `torch.save`, so that a kill meanwhile leaves the older one."""
    unfinished = path.with_suffix(f".tmp{os.getpid()}")  # another process may make the same
    torch.save(values, unfinished)
    os.replace(unfinished, path)


def _load(path: Path, settings: dict[str, Any]) -> MappedTerrain:
    values = torch.load(path, weights_only=True)
    there = values.pop("settings")
    differ = [name for name in settings if settings[name] != there.get(name)]
    mend = "remove the folder, or give the settings that it was made with"
    require(not differ, str(path), "must be of the same settings", f"other {', '.join(differ)}", mend)
    return MappedTerrain(**values | {"robot": RobotConfig(**values["robot"])})
