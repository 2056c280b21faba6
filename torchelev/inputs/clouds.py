"""Point clouds for the map: from depth images, and thinned by voxels."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Any

import torch
from torch import Tensor

from torchelev.errors import require, require_count, require_positive
from torchelev.frames.axes import require_axes, turn
from torchelev.inputs.checks import require_tensor
from torchelev.ops.transforms import is_readable

if TYPE_CHECKING:
    from jaxtyping import Float, Shaped


def depth_to_points(
    depth: Shaped[Tensor, "... h w"],
    intrinsics: Float[Tensor, "... 3 3"],
    along: str = "z",
    *,
    scale: float | None = None,
    frame: str = "optical",
) -> Float[Tensor, "... h*w 3"]:
    """Turn depth images into points [m] of the camera's frame.

    Depth that is zero, negative or not finite becomes a NaN point, which the map ignores.

    Args:
        depth: images without a channel dimension; floats [m], or integers in units of `scale`.
        intrinsics: one matrix in pixels, or one for each image.
        along: "z" for depth along the optical axis (pinhole cameras), "ray" for distance from the camera.
        scale: metres per unit of depth, such as 0.001 for millimetres. Required for integers; None: floats in metres.
        frame: axes of the pose that goes with the points. "optical" has x right, y down, z forward (ROS, OpenCV,
            RealSense); "opengl" has x right, y up, z backward, as the camera poses of MuJoCo and Isaac do; "forward"
            has x forward, y left, z up.

    Returns:
        Points (..., h * w, 3), row by row; float32 for integers, else in the dtype of the depth.

    Raises:
        ValueError: for another `along` or `frame`, a scale that is missing or not positive, or shapes that do not fit.
        TypeError: for a dtype that holds no depth.
    """
    require(along in ("z", "ray"), "along", 'must be "z" or "ray"', repr(along), 'pinhole depth images are "z"')
    require_axes("frame", frame)
    _check_images(depth, intrinsics)
    dtype = depth.dtype if depth.dtype.is_floating_point else torch.float32
    depth = _in_metres(depth, scale)
    intrinsics = intrinsics.to(depth)
    v = torch.arange(depth.shape[-2], device=depth.device, dtype=depth.dtype)[:, None]
    u = torch.arange(depth.shape[-1], device=depth.device, dtype=depth.dtype)
    fx, fy, cx, cy = (intrinsics[..., i, j, None, None] for i, j in ((0, 0), (1, 1), (0, 2), (1, 2)))
    x, y = torch.broadcast_tensors((u - cx) / fx, (v - cy) / fy)
    rays = torch.stack(turn([x, y, torch.ones_like(x)], "optical", frame), -1)
    if along == "ray":
        rays = rays / torch.linalg.vector_norm(rays, dim=-1, keepdim=True)
    hit = torch.isfinite(depth) & (depth > 0)
    return (rays * torch.where(hit, depth, math.nan)[..., None]).flatten(-3, -2).to(dtype)


def height_map_to_points(
    heights: Float[Tensor, "... h w"],
    resolution: float,
    origin: tuple[float, float],
    empty: float = 1e9,
) -> Float[Tensor, "... h*w 3"]:
    """Turn a height map that a robot sends into points [m] of its frame, one for each cell.

    Args:
        heights: [m]; cell [j, i] is at origin + (i, j) * resolution.
        resolution: side of a cell [m].
        origin: x, y [m] of cell [0, 0].
        empty: the value of cells without a height, beside NaN and infinity; Unitree's robots send 1e9.

    Returns:
        Points (..., h * w, 3), row by row; NaN where there is no height.

    Raises:
        ValueError: for a resolution that is not positive, or heights of one dimension.
        TypeError: for heights that are no floats.
    """
    is_float = isinstance(heights, Tensor) and heights.is_floating_point()
    require(is_float, "heights", "must be a tensor of floats", type(heights).__name__, "use .float()", TypeError)
    hint = "reshape the message's data to (height, width)"
    require(heights.ndim >= 2, "heights", "expected (..., h, w)", tuple(heights.shape), hint)
    require_positive(resolution=resolution)
    like: dict[str, Any] = {"device": heights.device, "dtype": heights.dtype}
    y = origin[1] + resolution * torch.arange(heights.shape[-2], **like)[:, None]
    x = origin[0] + resolution * torch.arange(heights.shape[-1], **like)
    known = torch.isfinite(heights) & (heights != empty)
    z = torch.where(known, heights, math.nan)
    x, y = x.expand_as(z), y.expand_as(z)
    return torch.stack([torch.where(known, x, math.nan), torch.where(known, y, math.nan), z], -1).flatten(-3, -2)


def _check_images(depth: Tensor, intrinsics: Tensor) -> None:
    """Refuse values that are not tensors, and depth images and intrinsics whose shapes do not match."""
    shape = tuple(require_tensor("depth", depth).shape)
    require_tensor("intrinsics", intrinsics)
    require(depth.ndim >= 2, "depth", "expected (..., h, w)", shape, "add the image dimensions")
    channel = depth.ndim > 2 and shape[-1] == 1
    require(not channel, "depth", "expected (..., h, w)", shape, "drop the channel dimension: depth.squeeze(-1)")
    rule, hint = "expected (..., 3, 3)", "give [[fx, 0, cx], [0, fy, cy], [0, 0, 1]]"
    require(intrinsics.shape[-2:] == (3, 3), "intrinsics", rule, tuple(intrinsics.shape), hint)
    images, matrices = shape[:-2], tuple(intrinsics.shape[:-2])
    paired = zip(reversed(images), reversed(matrices), strict=False)
    fits = len(matrices) <= len(images) and all(given in (1, number) for number, given in paired)
    rule = f"expected (3, 3) or {(*images, 3, 3)} for depth of {shape}"
    hint = "give one matrix for all images, or one for each; drop a channel dimension of the depth"
    require(fits, "intrinsics", rule, tuple(intrinsics.shape), hint)
    if is_readable(intrinsics):
        focal = intrinsics.detach().diagonal(dim1=-2, dim2=-1)[..., :2]
        wrong = focal[~((focal > 0) & focal.isfinite()).all(-1)]
        rule, hint = "must have positive, finite focal lengths", "give [[fx, 0, cx], [0, fy, cy], [0, 0, 1]] in pixels"
        require(not len(wrong), "intrinsics", rule, wrong[:1].tolist(), hint)


def _in_metres(depth: Tensor, scale: float | None) -> Tensor:
    """Return depth as floats [m], at least float32; integers need a scale, as their unit is not known."""
    kind = depth.dtype
    numbers = kind != torch.bool and not kind.is_complex
    require(numbers, "depth", "must be floats or integers", kind, "give metres, or integers and scale=", TypeError)
    known = kind.is_floating_point or scale is not None
    require(known, "scale", "is required for integer depth", "None", "give metres per unit: 0.001 for millimetres")
    if scale is not None:
        require_positive(scale=scale)
    depth = depth.to(_full_precision(kind))
    return depth if scale is None else depth * scale


def _full_precision(dtype: torch.dtype) -> torch.dtype:
    """Return the dtype to compute in: halves lose centimetres, and their sums overflow; integers become float32."""
    return torch.promote_types(dtype, torch.float32)


def voxel_filter(points: Float[Tensor, "B N 3"], size: float, max_points: int | None = None) -> Float[Tensor, "B K 3"]:
    """Replace the points of each voxel of edge `size` [m] by their mean, padded with NaN (paper, Table II "filtered").

    Batched and free of host synchronisation.

    Args:
        points: clouds; NaN or inf points are ignored.
        size: edge of a voxel [m].
        max_points: K, by default N. Given, the means come in order of their distance from the frame's origin, which
            is the sensor for points as `update` takes them, and of more than K voxels the nearest K are kept.

    Raises:
        ValueError: for a size or number that is not positive, or another shape.
        TypeError: for points that are not floats.
    """
    require(size > 0, "size", "must be positive", size, "give the voxel's edge in metres")
    fits = require_tensor("points", points).ndim == 3 and points.shape[-1] == 3
    require(fits, "points", "expected (B, N, 3)", tuple(points.shape), "add the first dimension: points[None]")
    floats, hint = points.dtype.is_floating_point, "convert them with .to(torch.float32)"
    require(floats, "points", "must be floats", points.dtype, hint, TypeError)
    means = _voxel_means(points.to(_full_precision(points.dtype)), size).to(points.dtype)
    if max_points is None:
        return means
    K = require_count("max_points", max_points, "give how many points to keep, or None")
    distance = torch.linalg.vector_norm(means.detach().double(), dim=-1).nan_to_num(math.inf)
    nearest = distance.argsort(dim=1, stable=True)[:, :K]
    means = means.gather(1, nearest[..., None].expand(-1, -1, 3))
    return torch.nn.functional.pad(means, (0, 0, 0, K - means.shape[1]), value=math.nan)


def _voxel_means(points: Float[Tensor, "B N 3"], size: float) -> Float[Tensor, "B N 3"]:
    """Return the mean of each voxel's points, padded with NaN."""
    B, N, _ = points.shape
    finite = torch.isfinite(points).all(-1) & (points.abs() < size * 2**20).all(-1)
    safe = torch.where(finite[..., None], points, 0.0)
    cell = torch.floor(safe / size).to(torch.int64) + 2**20
    key = torch.where(finite, (cell[..., 0] << 42) | (cell[..., 1] << 21) | cell[..., 2], torch.iinfo(torch.int64).max)
    key, order = key.sort(dim=1)
    is_first = torch.cat([torch.ones_like(key[:, :1], dtype=torch.bool), key[:, 1:] != key[:, :-1]], 1)
    voxel = torch.where(finite.gather(1, order), is_first.cumsum(1) - 1, N)
    total = points.new_zeros(B, N + 1, 3)
    total = total.scatter_add(1, voxel[..., None].expand(-1, -1, 3), safe.gather(1, order[..., None].expand(-1, -1, 3)))
    number = points.new_zeros(B, N + 1).scatter_add(1, voxel, torch.ones_like(points[..., 0]))
    mean = total / number.clamp(min=1)[..., None]
    return torch.where((number > 0)[..., None], mean, math.nan)[:, :N]
