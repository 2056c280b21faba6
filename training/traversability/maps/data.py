"""What a learned head sees and should say: maps of simulated ground, and the labels of their cells."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor
from tqdm import tqdm

from torchelev import ElevationMap
from torchelev.errors import require
from torchelev.output_files import atomic_file
from torchelev.robot import RobotConfig
from torchelev.sim import HeightField
from training.traversability.labels.labels import stand
from training.traversability.maps.mapping import DataConfig, exact_maps, tile_places, walk_and_map
from training.traversability.maps.terrain import KINDS, LENGTH, draw_robot, make_tiles

if TYPE_CHECKING:
    from jaxtyping import Bool, Float

VERSION = 1  # of maps and labels; raise it where their making changes, so that kept ones are refused
RATED_REACH = 0.3  # [m] around known cells in which unknown ones are rated
RESOLUTIONS = (0.02, 0.1)  # [m]
SPLITS = {"train": 0, "held_out": 1, "unseen": 2, "train_exact": 3, "held_out_exact": 4}
EXACT_SPLITS = ("train_exact", "held_out_exact")  # of maps that know the truth


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
    exact: bool = False,
) -> MappedTerrain:
    """Make maps of ground of random kinds; the same seed makes the same maps.

    Args:
        seed: of everything that chance decides.
        cfg: how many maps, of what.
        kinds: to draw the ground from.
        resolution: of the maps [m]; None: drawn from 2 to 10 cm, evenly in its logarithm, in whole millimetres.
        exact: maps that know the truth, in place of those that a robot makes.
    """
    cfg = cfg or DataConfig()
    rng = np.random.default_rng(seed)
    names = tuple(str(name) for name in rng.choice(list(kinds), cfg.num_maps))
    robot = draw_robot(rng) if cfg.robot is None else cfg.robot
    resolution = resolution or round(math.exp(rng.uniform(*np.log(RESOLUTIONS))), 3)
    field = make_tiles(names, rng)
    if exact:
        emap, T_tile_map = exact_maps(field, resolution, cfg, rng)
    else:
        emap, T_tile_map = walk_and_map(field, robot, resolution, cfg, rng)
    return label_cells(emap, T_tile_map, field, robot, cfg.headings, names)


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
            batch = make_batch(batch_seed(split, seed, index), cfg, kinds, resolution, split in EXACT_SPLITS)
            save_atomically({"settings": settings, **batch._asdict(), "robot": dataclasses.asdict(batch.robot)}, path)
        batches.append(_load(path, settings))
    return batches


def save_atomically(values: dict[str, Any], path: Path) -> None:
    """Write a file by `torch.save`, so that a kill meanwhile leaves the older one."""
    with atomic_file(path) as file:
        torch.save(values, file)


def _load(path: Path, settings: dict[str, Any]) -> MappedTerrain:
    values = torch.load(path, weights_only=True)
    there = values.pop("settings")
    differ = [name for name in settings if settings[name] != there.get(name)]
    hint = "remove the folder, or give the settings that it was made with"
    require(not differ, str(path), "must be of the same settings", f"other {', '.join(differ)}", hint)
    return MappedTerrain(**values | {"robot": RobotConfig(**values["robot"])})
