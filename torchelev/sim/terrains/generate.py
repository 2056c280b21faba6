"""Tiles of terrain to train on: height fields with their truth in closed form, ordered by kind and difficulty."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import torch
from torch import Tensor

from torchelev.checks import require_indices
from torchelev.errors import require, require_count, whole_cells
from torchelev.sim.terrains.heightfield import HeightField
from torchelev.sim.terrains.shapes import SHAPES, TABLE

if TYPE_CHECKING:
    from jaxtyping import Bool, Float, Int


@dataclass(frozen=True, eq=False, kw_only=True)
class Terrain:
    """K tiles. Each has its own frame with the origin at its centre, where a flat start platform lies at z = 0."""

    field: HeightField  #: what is walked on and seen: the truth at the samples, bilinear between
    kind: tuple[str, ...]  #: of each tile, by name
    kinds: tuple[str, ...]  #: those that there are
    kind_ids: Int[Tensor, "K"]  #: of each tile, a number in `kinds`
    difficulty: Float[Tensor, "K"]  #: 0 to 1
    random: Float[Tensor, "K R"]  #: each tile's table of chance, 0 to 1

    def truth(self, tile_ids: Int[Tensor, "B"], xy: Float[Tensor, "B M 2"]) -> Float[Tensor, "B M"]:
        """Return the ground's height [m] in closed form at places xy [m] of each environment's tile.

        It has exact edges where the field has none; at the samples both agree. Beyond the rim the rim's height goes on.
        """
        half = self.field.resolution * (self.field.heights.shape[1] - 1) / 2
        x, y = xy.clamp(-half, half).unbind(-1)
        difficulty, random = self.difficulty[tile_ids, None], self.random[tile_ids]
        z = torch.zeros_like(x)
        for number, name in enumerate(self.kinds):
            here = (self.kind_ids[tile_ids] == number)[:, None]
            z = torch.where(here, SHAPES[name](x, y, difficulty, random), z)
        return z


@dataclass(frozen=True, eq=False, kw_only=True)
class TerrainGrid(Terrain):
    """Tiles of each kind at each level of difficulty, and the rule by which robots change level: see `terrain_grid`."""

    num_levels: int  #: rows of tiles, from the easiest to the hardest

    def tile_ids(self, level: Int[Tensor, "B"], kind: Int[Tensor, "B"]) -> Int[Tensor, "B"]:
        """Return the tiles of levels 0 to num_levels - 1 and kinds, numbers in `kinds`.

        Raises ValueError for others, of tensors on the CPU.
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
        """Return the next levels: one up after a success, else one down after a failure, never below 0.

        Who succeeds on the last level goes to a random one, so that none is forgotten (the rule of legged_gym).
        """
        moved = (level + success.long() - (failure & ~success).long()).clamp(min=0)
        u = torch.rand(level.shape, generator=generator, device=level.device)
        anywhere = (u * self.num_levels).long().clamp(max=self.num_levels - 1)
        return torch.where(moved >= self.num_levels, anywhere, moved)


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
        kind: one of flat, slope, stairs_up, stairs_down, boxes, stepping_stones, gaps, rough, rails: see the table in
            `terrain_shapes`.
        difficulty: 0 to 1, of each tile.
        length: side of a tile [m].
        resolution: distance of the height field's samples [m].
        seed: of what chance decides; the same on all devices.

    Raises ValueError for another kind, a difficulty outside 0 to 1, and a length that is no multiple of the resolution.
    """
    difficulty = torch.as_tensor(difficulty)
    kind_ids = torch.zeros(difficulty.shape, dtype=torch.int64)
    return Terrain(**_tiles((kind,), kind_ids, difficulty, length, resolution, seed, device))


def terrain_grid(
    kinds: Sequence[str],
    num_levels: int,
    *,
    length: float = 8.0,
    resolution: float = 0.04,
    seed: int = 0,
    device: torch.device | str = "cpu",
) -> TerrainGrid:
    """Make a tile of each kind at each of `num_levels` difficulties, from 0 to 1 in equal steps.

    A single level has difficulty 1. A kind may come more than once, for tiles that chance makes different. See
    `make_terrain` for the other arguments. Raises ValueError as it does, and without kinds or levels.
    """
    require(len(kinds) > 0, "kinds", "must not be empty", list(kinds), "name some terrains")
    num_levels = require_count("num_levels", num_levels, "give the number of difficulties")
    levels = torch.linspace(0, 1, num_levels) if num_levels > 1 else torch.ones(1)
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
    """Return a terrain's fields; `kind_ids` (K,) says which of `kinds` each tile is."""
    for name in kinds:
        require(name in SHAPES, "kind", f"must be one of {', '.join(SHAPES)}", repr(name), "use one of them")
    within = difficulty.ndim == 1 and len(difficulty) > 0 and bool(((difficulty >= 0) & (difficulty <= 1)).all())
    require(within, "difficulty", "must be (K,) within 0 to 1", difficulty, "give one number for each tile")
    cells = whole_cells("length", length, resolution)
    # Drawn on the CPU: the tiles are then the same on all devices.
    random = torch.rand(len(difficulty), TABLE * TABLE, generator=torch.Generator().manual_seed(seed))
    difficulty = difficulty.float().cpu()
    kind = tuple(kinds[number] for number in kind_ids.tolist())
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
    along = ((torch.arange(samples, dtype=torch.float64) - (samples - 1) / 2) * resolution).float()
    x, y = (a.reshape(1, -1) for a in torch.meshgrid(along, along, indexing="ij"))
    tiles = zip(kind, difficulty[:, None, None], random[:, None], strict=True)
    return torch.cat([SHAPES[name](x, y, hard, table) for name, hard, table in tiles]).view(-1, samples, samples)
