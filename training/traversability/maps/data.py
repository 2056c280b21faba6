"""The data of training and evaluation: maps of simulated ground with labelled cells, and their files."""

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
from torchelev.robot import RobotConfig
from torchelev.sim import HeightField
from torchelev.traversability.trained_range import RESOLUTIONS
from training.fit import save_atomically
from training.traversability.labels.labels import can_stand
from training.traversability.maps.mapping import DataConfig, exact_maps, tile_cell_centers, walk_and_map
from training.traversability.maps.terrain import KINDS, LENGTH, draw_robot, make_tiles

if TYPE_CHECKING:
    from jaxtyping import Bool, Float

VERSION = 1  # of maps and labels; increase it when their computation changes, so that old files are refused
_RATED_REACH = 0.3  # [m] from known cells within which unknown cells are rated
SPLITS = {"train": 0, "held_out": 1, "unseen": 2, "train_exact": 3, "held_out_exact": 4}
_EXACT_SPLITS = ("train_exact", "held_out_exact")  # maps of the true heights


class MappedTerrain(NamedTuple):
    """B maps of one resolution for one robot, and the labels of their cells."""

    elevation: Float[Tensor, "B H W"]  #: [m]
    validity: Bool[Tensor, "B H W"]
    variance: Float[Tensor, "B H W"]  #: [m^2]
    upper_bound: Float[Tensor, "B H W"]  #: [m]
    bounded: Bool[Tensor, "B H W"]
    label: Float[Tensor, "B H W"]  #: fraction of the headings at which the robot can stand there; 0 where not rated
    rated: Bool[Tensor, "B H W"]  #: cells that count in training and metrics, see `rated_cells`
    resolution: float  #: [m]
    robot: RobotConfig
    kinds: tuple[str, ...]  #: of the terrain, one for each map

    @property
    def maps(self) -> tuple[Tensor, Tensor, Tensor, Tensor, Tensor]:
        """The inputs of a head, in the order of its arguments."""
        return self.elevation, self.validity, self.variance, self.upper_bound, self.bounded


def make_batch(
    seed: int | Sequence[int],
    cfg: DataConfig | None = None,
    kinds: Sequence[str] = KINDS,
    resolution: float | None = None,
    exact: bool = False,
) -> MappedTerrain:
    """Make maps of random kinds of ground; the same seed makes the same maps.

    Args:
        seed: of all random choices.
        cfg: number and settings of the maps.
        kinds: kinds of ground to draw from.
        resolution: of the maps [m]; None: log-uniform from 2 to 10 cm, in whole millimeters.
        exact: make maps of the true heights instead of maps from a simulated robot's sensors.
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
    """Copy the maps' layers and label their rated cells by where the robot can stand on the true ground."""
    grid, state = emap.cfg.grid, emap.state
    xy = tile_cell_centers(emap, T_tile_map)
    rated = rated_cells(state.validity, state.bounded, grid.resolution) & (xy.abs().amax(-1) <= LENGTH / 2)
    label = torch.zeros_like(state.elevation)
    for b in range(len(label)):  # the number of rated cells differs
        places = xy[b][rated[b]].float()
        stands = can_stand(field, torch.tensor([b]), places[None], [robot], headings)
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
    """Return the cells that count in training and metrics: bounded, or within 0.3 m of a known cell along both axes."""
    reach = round(_RATED_REACH / resolution)
    near = F.max_pool2d(validity.float()[:, None], 2 * reach + 1, 1, reach)[:, 0] > 0
    return near | bounded


# On disk ----------------------------------------------------------------------------------------------------------


def batch_seed(split: str, seed: int, index: int) -> list[int]:
    """Return the seed of a batch, different for every split, data set and batch."""
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
    """Return the first `count` batches of a data set: read from `folder`, or made and written there.

    Args:
        folder: where the batches are kept.
        split: a key of SPLITS.
        count: number of batches.
        seed: of the data set.
        cfg: settings of the maps.
        kinds: kinds of ground to draw from.
        resolution: of the maps [m]; None: random.

    Raises:
        ValueError: a file was made with other settings.
    """
    folder.mkdir(parents=True, exist_ok=True)
    settings = dataclasses.asdict(cfg) | {"kinds": list(kinds), "resolution": resolution, "version": VERSION}
    name = f"{split}-{seed}" + (f"-{1000 * resolution:g}mm" if resolution else "")
    batches = []
    for index in tqdm(range(count), desc=f"data {name}", unit="batch"):
        path = folder / f"{name}-{index:04d}.pt"
        if not path.exists():
            batch = make_batch(batch_seed(split, seed, index), cfg, kinds, resolution, split in _EXACT_SPLITS)
            save_atomically({"settings": settings, **batch._asdict(), "robot": dataclasses.asdict(batch.robot)}, path)
        batches.append(_load(path, settings))
    return batches


def _load(path: Path, settings: dict[str, Any]) -> MappedTerrain:
    values = torch.load(path, weights_only=True)
    actual = values.pop("settings")
    differ = [name for name in settings if settings[name] != actual.get(name)]
    hint = "remove the folder, or give the settings that it was made with"
    require(not differ, str(path), "must be of the same settings", f"other {', '.join(differ)}", hint)
    return MappedTerrain(**values | {"robot": RobotConfig(**values["robot"])})
