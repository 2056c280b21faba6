"""Terrain tiles for training: height fields of given kind and difficulty, with their ground truth in closed form."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import torch
from torch import Tensor

from torchelev.errors import require, require_count, whole_cells
from torchelev.inputs.checks import require_indices
from torchelev.sim.terrains.heightfield import HeightField
from torchelev.sim.terrains.shapes import SHAPES, TABLE

if TYPE_CHECKING:
    from jaxtyping import Bool, Float, Int
    from typing_extensions import Self


@dataclass(frozen=True, eq=False, kw_only=True)
class Terrain:
    """K tiles, each in its own frame, whose origin is the tile's centre: a flat start platform at z = 0."""

    field: HeightField  #: the surface to walk on and to see: the truth at the samples
    kind: tuple[str, ...]  #: name of each tile's kind
    kinds: tuple[str, ...]  #: the kinds that `kind_ids` refers to
    kind_ids: Int[Tensor, "K"]  #: index in `kinds` of each tile
    difficulty: Float[Tensor, "K"]  #: from 0 (easiest) to 1 (hardest)
    random: Float[Tensor, "K R"]  #: table of random numbers from 0 to 1 for each tile

    def with_surface(self, surface: str, diagonal: str = "rising") -> Self:
        """Return the same tiles with another surface between the samples; see `HeightField`."""
        return replace(self, field=self.field.with_surface(surface, diagonal))

    def truth(self, tile_ids: Int[Tensor, "B"], xy: Float[Tensor, "B M 2"]) -> Float[Tensor, "B M"]:
        """Return the true height [m] at xy [m] on each environment's tile, in closed form.

        Its edges are exact, while the field interpolates; at the samples both agree. Beyond the rim of a tile the
        height of the rim continues.
        """
        half = self.field.resolution * (self.field.heights.shape[1] - 1) / 2
        x, y = xy.clamp(-half, half).unbind(-1)
        difficulty, random = self.difficulty[tile_ids, None], self.random[tile_ids]
        z = torch.zeros_like(x)
        for index, name in enumerate(self.kinds):
            is_kind = (self.kind_ids[tile_ids] == index)[:, None]
            z = torch.where(is_kind, SHAPES[name](x, y, difficulty, random), z)
        return z


@dataclass(frozen=True, eq=False, kw_only=True)
class TerrainGrid(Terrain):
    """Tiles of each kind at each difficulty level, with a curriculum over the levels; see `terrain_grid`."""

    num_levels: int  #: number of difficulties, from the easiest to the hardest

    def tile_ids(self, level: Int[Tensor, "B"], kind: Int[Tensor, "B"]) -> Int[Tensor, "B"]:
        """Return the tiles of given levels and kinds.

        Args:
            level: From 0 to num_levels - 1.
            kind: Indices in `kinds`.

        Raises:
            ValueError: A level or kind does not exist; checked for tensors on the CPU.
        """
        require_indices("level", level, self.num_levels)
        require_indices("kind", kind, len(self.kinds))
        return level * len(self.kinds) + kind

    def promote(
        self,
        level: Int[Tensor, "B"],
        success: Bool[Tensor, "B"],
        failure: Bool[Tensor, "B"],
        generator: torch.Generator | None = None,
    ) -> Int[Tensor, "B"]:
        """Return the next levels: one up after a success, otherwise one down after a failure, but never below 0.

        A robot that succeeds at the last level continues at a random one, so that no level is forgotten (the rule of
        legged_gym).

        Args:
            level: Current levels.
            success: Which robots have mastered their level.
            failure: Which robots have failed.
            generator: Source of the random levels; None is torch's default generator.
        """
        next_level = (level + success.long() - (failure & ~success).long()).clamp(min=0)
        u = torch.rand(level.shape, generator=generator, device=level.device)
        random_level = (u * self.num_levels).long().clamp(max=self.num_levels - 1)
        return torch.where(next_level >= self.num_levels, random_level, next_level)


def make_terrain(
    kind: str,
    difficulty: Float[Tensor, "K"],
    *,
    length: float = 8.0,
    resolution: float = 0.04,
    seed: int = 0,
    device: torch.device | str = "cpu",
) -> Terrain:
    """Make K tiles of one kind.

    Args:
        kind: One of flat, slope, stairs_up, stairs_down, boxes, stepping_stones, gaps, rough, rails; see the table in
            `torchelev.sim.terrains.shapes`.
        difficulty: Of each tile, from 0 to 1.
        length: Side of a tile [m].
        resolution: Distance between the samples of the height field [m].
        seed: Seed of the random shapes; the same seed gives the same tiles on every device.
        device: Where the tiles are stored.

    Raises:
        ValueError: The kind does not exist, a difficulty is not within 0 to 1, or the length is not a multiple of the
            resolution.
    """
    difficulty = torch.as_tensor(difficulty)
    kind_ids = torch.zeros(difficulty.shape, dtype=torch.int64)
    return Terrain(**_tiles((kind,), kind_ids, difficulty, length, resolution, seed, device))


def terrain_grid(
    kinds: Sequence[str],
    num_levels: int,
    *,
    difficulty: tuple[float, float] = (0.0, 1.0),
    length: float = 8.0,
    resolution: float = 0.04,
    seed: int = 0,
    device: torch.device | str = "cpu",
) -> TerrainGrid:
    """Make a tile of each kind at each difficulty level.

    Args:
        kinds: Names of the kinds, as in `make_terrain`. A repeated kind gives further random tiles of that kind.
        num_levels: Number of difficulties.
        difficulty: Those of the first and the last level, with equal steps between; a single level has the last one.
        length: Side of a tile [m].
        resolution: Distance between the samples of the height field [m].
        seed: Seed of the random shapes; the same seed gives the same tiles on every device.
        device: Where the tiles are stored.

    Raises:
        ValueError: There is no kind or no level, or an argument is one that `make_terrain` refuses.
    """
    require(len(kinds) > 0, "kinds", "must not be empty", list(kinds), "name some terrains")
    num_levels = require_count("num_levels", num_levels, "give the number of difficulties")
    levels = torch.linspace(*difficulty, num_levels) if num_levels > 1 else torch.tensor([difficulty[1]])
    kind_ids = torch.arange(len(kinds)).repeat(num_levels)
    tiles = _tiles(tuple(kinds), kind_ids, levels.repeat_interleave(len(kinds)), length, resolution, seed, device)
    return TerrainGrid(num_levels=num_levels, **tiles)


def _tiles(
    kinds: tuple[str, ...],
    kind_ids: Tensor,
    difficulty: Tensor,
    length: float,
    resolution: float,
    seed: int,
    device: torch.device | str,
) -> dict[str, Any]:
    """Return the fields of a `Terrain`; `kind_ids` (K,) are indices in `kinds`."""
    for name in kinds:
        require(name in SHAPES, "kind", f"must be one of {', '.join(SHAPES)}", repr(name), "use one of them")
    fits = difficulty.ndim == 1 and len(difficulty) > 0 and bool(((difficulty >= 0) & (difficulty <= 1)).all())
    require(fits, "difficulty", "must be (K,) within 0 to 1", difficulty, "give one number for each tile")
    cells = whole_cells("length", length, resolution)
    # Drawn on the CPU, so that the tiles are the same on all devices.
    random = torch.rand(len(difficulty), TABLE * TABLE, generator=torch.Generator().manual_seed(seed))
    difficulty = difficulty.float().cpu()
    kind = tuple(kinds[index] for index in kind_ids.tolist())
    heights = _heights(kind, difficulty, random, cells + 1, resolution)
    return {
        "field": HeightField(heights.to(device), resolution),
        "kind": kind,
        "kinds": kinds,
        "kind_ids": kind_ids.to(device),
        "difficulty": difficulty.to(device),
        "random": random.to(device),
    }


def _heights(kind: tuple[str, ...], difficulty: Tensor, random: Tensor, samples: int, resolution: float) -> Tensor:
    """Return the heights (K, samples, samples) [m] of the tiles."""
    axis = ((torch.arange(samples, dtype=torch.float64) - (samples - 1) / 2) * resolution).float()
    x, y = (a.reshape(1, -1) for a in torch.meshgrid(axis, axis, indexing="ij"))
    tiles = zip(kind, difficulty[:, None, None], random[:, None], strict=True)
    return torch.cat([SHAPES[name](x, y, level, table) for name, level, table in tiles]).view(-1, samples, samples)
