"""Maps of simulated walks, as they were after some scans, with the true ground; and their files."""

from __future__ import annotations

import contextlib
import dataclasses
import functools
import math
import multiprocessing
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
import torch
from torch import Tensor
from tqdm import tqdm

from torchelev import ElevationMap
from torchelev.completion.complete import CompletionInput
from torchelev.errors import require, require_positive
from torchelev.files.weight_files import RESOLUTIONS
from torchelev.sim import HeightField
from training.completion.yards import drive_and_look
from training.fit import save_atomically
from training.traversability.maps.mapping import DataConfig, Look, blank_map, tile_cell_centers, walk_and_look
from training.traversability.maps.terrain import COLLAGE, KINDS, LOOK_INTERVAL, UNSEEN_KINDS, draw_robot, make_tiles

if TYPE_CHECKING:
    from jaxtyping import Bool, Float

VERSION = 1  # of the maps; increase it when their computation changes, so that old files are refused
YARD = "yard"
_YARD_RESOLUTIONS = (0.04, 0.1)  # [m]
SPLITS = {
    "train": KINDS,
    "held_out": KINDS,
    "unseen": UNSEEN_KINDS,
    "yards": (YARD,),
    "held_out_yards": (YARD,),
    "collages": (COLLAGE,),
}


@dataclass(frozen=True, kw_only=True)
class WalkConfig:
    """Settings of the maps."""

    num_maps: int = 4  #: per walk; they share robot, sensors and resolution
    window: float = 4.0  #: [m] side of a map, rounded to whole cells
    scans: tuple[int, ...] = (1, 3, 6, 10)  #: after which the maps are kept; occlusions shrink from view to view

    def __post_init__(self) -> None:
        require_positive(num_maps=self.num_maps, window=self.window)
        ascends = len(self.scans) > 0 and self.scans[0] >= 1 and sorted(set(self.scans)) == list(self.scans)
        require(ascends, "scans", "must be positive and ascend", self.scans, "see its default")


YARD_CONFIG = WalkConfig(window=12.0, scans=(1, 2, 4))  # of drives


class TrueMap(NamedTuple):
    """B maps at one instant, and the true ground."""

    layers: CompletionInput  #: (B, H, W) each
    truth: Float[Tensor, "B H W"]  #: [m]
    is_inside: Bool[Tensor, "B H W"]  #: the simulated ground reaches there
    resolution: float  #: [m]
    kinds: tuple[str, ...]  #: of the ground, one for each map
    scans: int  #: that the map has fused


def walk(seed: Sequence[int], kinds: Sequence[str], resolution: float | None, cfg: WalkConfig) -> list[TrueMap]:
    """Walk over random ground of some kinds; return the maps after each of `cfg.scans`.

    Args:
        seed: of all random choices.
        kinds: kinds of ground to draw from.
        resolution: of the maps [m]; None: log-uniform from 2 to 10 cm, in whole millimetres.
        cfg: number and settings of the maps.
    """
    rng = np.random.default_rng(list(seed))
    names = tuple(str(name) for name in rng.choice(list(kinds), cfg.num_maps))
    robot, last = draw_robot(rng), cfg.scans[-1]
    resolution = resolution or round(math.exp(rng.uniform(*np.log(RESOLUTIONS))), 3)
    field = make_tiles(names, rng)
    emap = blank_map(resolution, cfg.window, cfg.num_maps)
    looks = walk_and_look(field, robot, DataConfig(num_maps=cfg.num_maps, window=cfg.window, looks=(last, last)), rng)
    return _fuse(emap, field, looks, names, cfg)


def drive(seed: Sequence[int], resolution: float | None, cfg: WalkConfig) -> list[TrueMap]:
    """Drive through yards; return the maps after each of `cfg.scans`. Arguments are those of `walk`."""
    rng = np.random.default_rng(list(seed))
    resolution = resolution or round(math.exp(rng.uniform(*np.log(_YARD_RESOLUTIONS))), 3)
    field, looks = drive_and_look(cfg.num_maps, cfg.scans[-1], rng)
    emap = blank_map(resolution, cfg.window, cfg.num_maps)
    return _fuse(emap, field, looks, (YARD,) * cfg.num_maps, cfg)


def _fuse(
    emap: ElevationMap, field: HeightField, looks: Iterable[Look], kinds: tuple[str, ...], cfg: WalkConfig
) -> list[TrueMap]:
    maps = []
    for number, look in enumerate(looks, 1):
        emap.update(look.points, look.T_map_sensor, look.T_map_base, LOOK_INTERVAL)
        if number in cfg.scans:
            maps.append(_with_truth(emap, field, look, kinds, number))
    return maps


def _with_truth(emap: ElevationMap, field: HeightField, look: Look, kinds: tuple[str, ...], scans: int) -> TrueMap:
    """Return a copy of the maps, and the true height of their cells, given where the robots truly are."""
    T_tile_base, T_map_base = look.T_tile_base, look.T_map_base
    T_tile_map = T_tile_base @ torch.linalg.inv(T_map_base)
    xy = tile_cell_centers(emap, T_tile_map)
    tiles = torch.arange(field.num_tiles)
    height = field.height(tiles, xy.float().flatten(1, 2)).view(xy.shape[:3])
    rise = (T_map_base[:, 2, 3] - T_tile_base[:, 2, 3]).float()
    state = emap.state
    layers = (state.elevation, state.validity, state.variance, state.upper_bound, state.bounded, state.time)
    copies = CompletionInput(*(layer.clone() for layer in layers))
    is_inside = xy.abs().amax(-1) <= (field.heights.shape[1] - 1) * field.resolution / 2
    return TrueMap(copies, height + rise[:, None, None], is_inside, emap.cfg.grid.resolution, kinds, scans)


# On disk ----------------------------------------------------------------------------------------------------------


class Walks(NamedTuple):
    """Which walks to make: a file each."""

    folder: Path
    split: str  #: a key of SPLITS
    seed: int  #: of the data set
    cfg: WalkConfig
    resolution: float | None = None  #: [m]; None: random

    @property
    def name(self) -> str:
        """The beginning of the files' names."""
        return f"{self.split}-{self.seed}" + (f"-{1000 * self.resolution:g}mm" if self.resolution else "")

    def path(self, index: int) -> Path:
        """Return the path of a walk's file."""
        return self.folder / f"{self.name}-{index:04d}.pt"

    @property
    def settings(self) -> dict[str, object]:
        """The settings that a file must have been made with."""
        kinds = list(SPLITS[self.split])
        return dataclasses.asdict(self.cfg) | {"kinds": kinds, "resolution": self.resolution, "version": VERSION}

    def make(self, index: int) -> None:
        """Make a walk and write its file."""
        seed = [list(SPLITS).index(self.split), self.seed, index]
        kinds = SPLITS[self.split]
        make = drive if kinds == (YARD,) else functools.partial(walk, kinds=kinds)
        maps = make(seed, resolution=self.resolution, cfg=self.cfg)
        plain = [entry._replace(layers=tuple(entry.layers))._asdict() for entry in maps]  # type: ignore[arg-type]
        save_atomically({"settings": self.settings, "maps": plain}, self.path(index))

    def read(self, index: int) -> list[TrueMap]:
        """Return a walk's maps.

        Raises:
            ValueError: the file was made with other settings.
        """
        path = self.path(index)
        found = torch.load(path, weights_only=True)
        differ = [name for name, value in self.settings.items() if _plain(found["settings"].get(name)) != _plain(value)]
        hint = "remove the folder, or give the settings that it was made with"
        require(not differ, str(path), "must be of the same settings", f"other {', '.join(differ)}", hint)
        return [TrueMap(**entry | {"layers": CompletionInput(*entry["layers"])}) for entry in found["maps"]]


def _plain(value: object) -> object:
    return list(value) if isinstance(value, tuple) else value


def make_walks(walks: Walks, count: int, jobs: int) -> None:
    """Make the first `count` walks of a data set that are not there yet, in several processes."""
    walks.folder.mkdir(parents=True, exist_ok=True)
    missing = [index for index in range(count) if not walks.path(index).exists()]
    if not missing:
        return
    bar = tqdm(total=count, initial=count - len(missing), desc=f"walks {walks.name}", unit="walk")
    with bar, contextlib.ExitStack() as stack:
        made: Iterable[None] = map(walks.make, missing)
        if jobs > 1:
            pool = multiprocessing.get_context("spawn").Pool(jobs, torch.set_num_threads, (1,))
            made = stack.enter_context(pool).imap_unordered(walks.make, missing)
        for _ in made:
            bar.update()
