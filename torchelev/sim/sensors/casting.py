"""Rays against height fields and boxes, batched over environments."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, NamedTuple

import torch
from torch import Tensor

from torchelev.checks import require_indices
from torchelev.errors import require
from torchelev.ops.storage import keep_freed_memory
from torchelev.sim.sensors.tracing import HUGE, trace
from torchelev.sim.terrains.heightfield import HeightField

if TYPE_CHECKING:
    from jaxtyping import Float, Int


MAX_RAYS = 2**18  # cast at once, which bounds the memory that it takes


class Boxes(NamedTuple):
    """K boxes in each environment. Those with a half size of zero or less, or without a finite pose, are not there."""

    T_map_box: Float[Tensor, "B K 4 4"]  #: the box's frame lies in its middle
    half_size: Float[Tensor, "B K 3"]  #: [m]

    def moved(self, T: Float[Tensor, "B 4 4"]) -> Boxes:
        """Return the boxes, given in frame b, in frame a: `T` is T_a_b."""
        return Boxes(T[:, None].to(self.T_map_box.dtype) @ self.T_map_box, self.half_size)

    def joined(self, other: Boxes) -> Boxes:
        """Return these boxes and the others."""
        T = torch.cat([self.T_map_box, other.T_map_box.to(self.T_map_box.dtype)], 1)
        return Boxes(T, torch.cat([self.half_size, other.half_size.to(self.half_size.dtype)], 1))


def cast(
    field: HeightField,
    tile_ids: Int[Tensor, "B"],
    origin: Float[Tensor, "B 3"],
    directions: Float[Tensor, "B M 3"],
    max_range: float,
    boxes: Boxes | None = None,
) -> Float[Tensor, "B M"]:
    """Return the distance [m] to the first hit of each ray, float32, inf where there is none within `max_range`.

    `origin` [m] and unit `directions` are in the map frame, which is that of the environment's tile. A ray that starts
    below the ground or inside a box hits at once; rays from an origin that is not finite hit nothing. No hit is inf and
    not NaN: the nearer of two hits is then their minimum, and comparing needs no exception. There is no gradient. Which
    rays are cast together changes a distance by rounding alone.

    Raises ValueError or TypeError for shapes, devices and dtypes that do not fit and, on a CPU, for unknown tile ids.
    """
    _check(field, tile_ids, origin, directions, max_range)
    if boxes is not None:
        _check_boxes(boxes, len(tile_ids))
    if origin.device.type == "cpu":
        keep_freed_memory()
    B, M = directions.shape[:2]
    some = max(1, MAX_RAYS // max(1, M))
    parts = []
    with torch.no_grad():
        for first in range(0, max(1, B), some):
            envs = slice(first, first + some)
            near = None if boxes is None else Boxes(*(value[envs] for value in boxes))
            rays = tile_ids[envs], origin[envs].float(), directions[envs].float()
            parts.append(_nearest(field, *rays, max_range, near))
        return torch.cat(parts)


def _nearest(
    field: HeightField, tile_ids: Tensor, origin: Tensor, directions: Tensor, max_range: float, boxes: Boxes | None
) -> Tensor:
    nearest = trace(field, tile_ids, origin, directions, max_range)
    if boxes is not None:
        nearest = torch.minimum(nearest, distance_to_boxes(boxes, origin, directions))
    hit = (nearest <= max_range) & origin.isfinite().all(-1, keepdim=True)
    return nearest.masked_fill(~hit, math.inf)


def _check(field: HeightField, tile_ids: Tensor, origin: Tensor, directions: Tensor, max_range: float) -> None:
    B = len(tile_ids)
    fits = tuple(origin.shape) == (B, 3) and directions.ndim == 3 and directions.shape[::2] == (B, 3)
    actual = f"{tuple(origin.shape)} and {tuple(directions.shape)}"
    require(fits, "origin, directions", f"expected ({B}, 3) and ({B}, M, 3)", actual, "give one origin per tile id")
    whole = tile_ids.dtype == torch.int64
    require(whole, "tile_ids", "must be int64", tile_ids.dtype, "convert them with .to(torch.int64)", TypeError)
    devices = [value.device for value in (tile_ids, origin, directions)]
    there = all(device == field.device for device in devices)
    require(there, "tile_ids, origin, directions", f"must be on {field.device}", devices, "move them, or the field")
    require(0 < max_range < math.inf, "max_range", "must be positive and finite", max_range, "give metres")
    require_indices("tile_ids", tile_ids, field.num_tiles, "number tiles from 0")


def _check_boxes(boxes: Boxes, num_envs: int) -> None:
    K = boxes.half_size.shape[1]
    fits = tuple(boxes.T_map_box.shape) == (num_envs, K, 4, 4) and tuple(boxes.half_size.shape) == (num_envs, K, 3)
    actual = f"{tuple(boxes.T_map_box.shape)} and {tuple(boxes.half_size.shape)}"
    require(fits, "boxes", f"expected ({num_envs}, K, 4, 4) and ({num_envs}, K, 3)", actual, "pad with half sizes of 0")


def distance_to_boxes(
    boxes: Boxes, origin: Float[Tensor, "B 3"], directions: Float[Tensor, "B M 3"]
) -> Float[Tensor, "B M"]:
    """Return the distance [m] to where each ray enters the first box, more than HUGE where it meets none.

    Between the planes of a pair of faces a ray is from (-x - h) / d to (-x + h) / d, with its start x, its direction d
    and the half size h along their normal. It is in the box where it is between all three pairs (slab method).
    """
    K = boxes.half_size.shape[1]
    if not K:
        return directions.new_full(directions.shape[:2], math.inf)
    rotation = boxes.T_map_box[..., :3, :3].permute(0, 3, 1, 2)  # (B, axis of the box, K, axis of the map)
    offset = origin[:, None] - boxes.T_map_box[..., :3, 3]
    start = (rotation * offset[:, None]).sum(-1).to(origin.dtype)[..., None]
    along = (rotation.to(origin.dtype).flatten(1, 2) @ directions.mT).unflatten(1, (3, K))
    present = (boxes.half_size > 0).all(-1, keepdim=True)
    half = torch.where(present, boxes.half_size, math.nan).to(origin.dtype).transpose(1, 2)[..., None]
    inverse = along.reciprocal_()  # infinite for a ray parallel to a pair of faces: always or never between them
    near, far = inverse * (-start - half), inverse.mul_(half - start)
    enter = torch.minimum(near, far).amax(1).clamp_(min=0)
    leave = torch.maximum(near, far, out=far).amin(1)
    entry = enter.add_((enter - leave).clamp_(min=0), alpha=HUGE)  # arithmetic: see tracing
    return entry.nan_to_num_(math.inf, math.inf).amin(1)
