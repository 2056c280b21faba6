"""Ray casting against height fields and boxes, batched over environments."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import torch
from torch import Tensor

from torchelev.errors import require
from torchelev.inputs.checks import require_indices
from torchelev.ops.storage import keep_freed_memory
from torchelev.sim.boxes import Boxes
from torchelev.sim.sensors import casting_kernel
from torchelev.sim.sensors.crossing import HUGE
from torchelev.sim.sensors.tracing import trace
from torchelev.sim.terrains.heightfield import HeightField

if TYPE_CHECKING:
    from jaxtyping import Float, Int


MAX_RAYS = 2**18  # cast at once; bounds the memory


def cast(
    field: HeightField,
    tile_ids: Int[Tensor, "B"],
    origin: Float[Tensor, "B 3"],
    directions: Float[Tensor, "B M 3"],
    max_range: float,
    boxes: Boxes | None = None,
) -> Float[Tensor, "B M"]:
    """Return the distance [m] to the first hit of each ray, float32, inf where nothing is hit within `max_range`.

    A ray that starts below the ground or inside a box has distance 0. Rays from an origin that is not finite hit
    nothing. Distances have no gradient. They depend on the other rays of the batch only by rounding.

    Args:
        field: Terrain tiles.
        tile_ids: The tile of each environment, int64.
        origin: Common origin of an environment's rays [m], in the frame of its tile.
        directions: Unit vectors, in the frame of the tile.
        max_range: Longest distance that is returned [m].
        boxes: Boxes in the frame of the tile.

    Raises:
        TypeError: `tile_ids` is not int64.
        ValueError: A shape or device does not fit, or, on a CPU, a tile id does not exist.
    """
    _check(field, tile_ids, origin, directions, max_range)
    if boxes is not None:
        _check_boxes(boxes, len(tile_ids))
    if origin.device.type == "cpu":
        keep_freed_memory()
    B, M = directions.shape[:2]
    chunk = max(1, MAX_RAYS // max(1, M))
    parts = []
    with torch.no_grad():
        for first in range(0, max(1, B), chunk):
            envs = slice(first, first + chunk)
            part = None if boxes is None else Boxes(*(value[envs] for value in boxes))
            rays = tile_ids[envs], origin[envs].float(), directions[envs].float()
            parts.append(_cast_part(field, *rays, max_range, part))
        return torch.cat(parts)


def see(
    field: HeightField,
    tile_ids: Int[Tensor, "B"],
    T_map_sensor: Float[Tensor, "B 4 4"],
    rays: Float[Tensor, "*B M 3"],
    min_range: float,
    max_range: float,
) -> Float[Tensor, "B M 3"]:
    """Return the points [m] that sensors see, sensor frame, float32; NaN where none lies in between the ranges.

    Arguments and errors are those of `cast`, with poses and unit vectors of the sensors, float32.
    """
    shape = (len(tile_ids), *rays.shape[-2:])
    if rays.ndim == 2 and rays.is_cpu:
        _check(field, tile_ids, T_map_sensor[:, :3, 3], rays.expand(shape), max_range)
        points = casting_kernel.see(field, tile_ids, T_map_sensor, rays, min_range, max_range)
        if points is not None:
            return points
    rays = rays.expand(shape)
    directions = rays @ T_map_sensor[:, :3, :3].mT
    return to_points(rays, cast(field, tile_ids, T_map_sensor[:, :3, 3], directions, max_range), min_range)


def to_points(rays: Float[Tensor, "B M 3"], distance: Float[Tensor, "B M"], min_range: float) -> Float[Tensor, "B M 3"]:
    """Return the points [m] at distances along rays, NaN where these are infinite or below `min_range`."""
    is_returned = (distance >= min_range) & (distance < math.inf)
    return rays * distance.masked_fill(~is_returned, math.nan)[..., None]


def _cast_part(
    field: HeightField, tile_ids: Tensor, origin: Tensor, directions: Tensor, max_range: float, boxes: Boxes | None
) -> Tensor:
    nearest = None
    if origin.is_cpu:
        nearest = casting_kernel.cast(field, tile_ids, origin, directions, max_range, _describe_boxes(boxes, origin))
    if nearest is None:
        nearest = trace(field, tile_ids, origin, directions, max_range)
        if boxes is not None:
            nearest = torch.minimum(nearest, _distance_to_boxes(boxes, origin, directions))
    hit = (nearest <= max_range) & origin.isfinite().all(-1, keepdim=True)
    return nearest.masked_fill(~hit, math.inf)


def _describe_boxes(boxes: Boxes | None, origin: Float[Tensor, "B 3"]) -> Float[Tensor, "B K 15"]:
    """Return each box's axes, the rays' origin in its frame [m] and half its sides [m], NaN if it is absent."""
    if boxes is None:
        return origin.new_empty(len(origin), 0, 15)
    axes = boxes.T_map_box[..., :3, :3].mT
    start = (axes * (origin[:, None] - boxes.T_map_box[..., :3, 3])[:, :, None]).sum(-1)
    is_present = (boxes.half_size > 0).all(-1, keepdim=True)
    half = torch.where(is_present, boxes.half_size, math.nan)
    return torch.cat([value.to(origin.dtype) for value in (axes.flatten(2), start, half)], -1)


def _check(field: HeightField, tile_ids: Tensor, origin: Tensor, directions: Tensor, max_range: float) -> None:
    B = len(tile_ids)
    fits = tuple(origin.shape) == (B, 3) and directions.ndim == 3 and directions.shape[::2] == (B, 3)
    actual = f"{tuple(origin.shape)} and {tuple(directions.shape)}"
    require(fits, "origin, directions", f"expected ({B}, 3) and ({B}, M, 3)", actual, "give one origin per tile id")
    is_int64 = tile_ids.dtype == torch.int64
    require(is_int64, "tile_ids", "must be int64", tile_ids.dtype, "convert them with .to(torch.int64)", TypeError)
    devices = [value.device for value in (tile_ids, origin, directions)]
    is_same = all(device == field.device for device in devices)
    require(is_same, "tile_ids, origin, directions", f"must be on {field.device}", devices, "move them, or the field")
    require(0 < max_range < math.inf, "max_range", "must be positive and finite", max_range, "give metres")
    require_indices("tile_ids", tile_ids, field.num_tiles, "number tiles from 0")


def _check_boxes(boxes: Boxes, num_envs: int) -> None:
    K = boxes.half_size.shape[1]
    fits = tuple(boxes.T_map_box.shape) == (num_envs, K, 4, 4) and tuple(boxes.half_size.shape) == (num_envs, K, 3)
    actual = f"{tuple(boxes.T_map_box.shape)} and {tuple(boxes.half_size.shape)}"
    require(fits, "boxes", f"expected ({num_envs}, K, 4, 4) and ({num_envs}, K, 3)", actual, "pad with half sizes of 0")


def _distance_to_boxes(
    boxes: Boxes, origin: Float[Tensor, "B 3"], directions: Float[Tensor, "B M 3"]
) -> Float[Tensor, "B M"]:
    """Return the distance [m] at which each ray enters its first box, more than HUGE where it misses all (slab method).

    Along the normal of a pair of faces, let x be the ray's origin, d its direction and h the half size. The ray is
    between the two faces from (-x - h) / d to (-x + h) / d, and inside the box where it is between all three pairs.
    """
    K = boxes.half_size.shape[1]
    if not K:
        return directions.new_full(directions.shape[:2], math.inf)
    rotation = boxes.T_map_box[..., :3, :3].permute(0, 3, 1, 2)  # (B, axis of the box, K, axis of the map)
    offset = origin[:, None] - boxes.T_map_box[..., :3, 3]
    start = (rotation * offset[:, None]).sum(-1).to(origin.dtype)[..., None]
    along = (rotation.to(origin.dtype).flatten(1, 2) @ directions.mT).unflatten(1, (3, K))
    is_present = (boxes.half_size > 0).all(-1, keepdim=True)
    half = torch.where(is_present, boxes.half_size, math.nan).to(origin.dtype).transpose(1, 2)[..., None]
    inverse = along.reciprocal_()  # inf for a ray parallel to the faces, which is always or never between them
    near, far = inverse * (-start - half), inverse.mul_(half - start)
    enter = torch.minimum(near, far).amax(1).clamp_(min=0)
    leave = torch.maximum(near, far, out=far).amin(1)
    entry = enter.add_((enter - leave).clamp_(min=0), alpha=HUGE)  # arithmetic in place of a condition: see tracing
    return entry.nan_to_num_(math.inf, math.inf).amin(1)
