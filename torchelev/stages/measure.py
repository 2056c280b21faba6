"""From a sensor's points to a measurement: transform, gates, noise. Depth images and voxel filtering too."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING

import torch
from torch import Tensor

from torchelev.checks import FARTHEST, readable, require_tensor
from torchelev.errors import require, require_count, require_positive
from torchelev.grid import GridConfig
from torchelev.ops.storage import realize, realize_all
from torchelev.state import Measurement, count

if TYPE_CHECKING:
    from jaxtyping import Bool, Float, Shaped


@dataclass(frozen=True, kw_only=True)
class ExclusionConfig:
    """The ramp of the paper's Fig. 3: points above it are overhangs, not ground."""

    slope: float = 0.3  #: tan(theta_a)
    distance: float = 1.0  #: [m] b: horizontal distance at which the ramp starts to rise
    offset: float = 0.2  #: [m] c: height above the sensor before b
    height: float = 1.0  #: [m] d: height above the sensor that is never exceeded


@dataclass(frozen=True, kw_only=True)
class BodyConfig:
    """A box in the base frame that holds the robot; points inside are the robot's own."""

    lower: tuple[float, float, float] = (-0.4, -0.25, -0.2)  #: [m]
    upper: tuple[float, float, float] = (0.4, 0.25, 0.3)  #: [m]


@dataclass(frozen=True, kw_only=True)
class SensorConfig:
    """Noise model and gates of the points."""

    noise_factor: float = 1e-4  #: alpha_d: sigma_p^2 = alpha_d * d^2 + noise_floor; 1 % of the distance
    noise_floor: float = 2.5e-5  #: [m^2] (5 mm)^2
    min_distance: float = 0.1  #: [m]
    max_distance: float = 50.0  #: [m]
    #: ramp above which points are overhangs; None: every point counts
    exclusion: ExclusionConfig | None = ExclusionConfig()
    body: BodyConfig | None = None  #: box around the robot whose points are ignored; None: none are

    def __post_init__(self) -> None:
        require(self.noise_factor >= 0, "sensor.noise_factor", "must not be negative", self.noise_factor, "give 1e-4")
        require(self.noise_floor > 0, "sensor.noise_floor", "must be positive", self.noise_floor, "give 2.5e-5 m^2")
        ordered, actual = 0 <= self.min_distance < self.max_distance, (self.min_distance, self.max_distance)
        hint = "give 0 <= min < max in metres"
        require(ordered, "sensor.min_distance, max_distance", "must be ordered", actual, hint)


def above_ramp(relative: Float[Tensor, "B M 3"], ramp: ExclusionConfig) -> Bool[Tensor, "B M"]:
    """Tell which points lie in the exclusion area (paper, Sec. II-C and Fig. 3).

    z - z_s > min(max(r - b, 0) * tan(theta_a) + c, d), with r the horizontal distance from the sensor.
    `relative` is the point less the sensor's position, in map axes [m].
    """
    r = (relative[..., 0].square() + relative[..., 1].square()).clamp(min=1e-12).sqrt()
    limit = ((r - ramp.distance).clamp(min=0) * ramp.slope + ramp.offset).clamp(max=ramp.height)
    return relative[..., 2] > limit


def inside_body(points: Float[Tensor, "B M 3"], T_map_base: Tensor, base: Tensor, body: BodyConfig) -> Tensor:
    """Tell which points lie in the robot's body box, which turns with the base."""
    to_base = T_map_base[:, :3, :3].to(points.dtype).transpose(1, 2)
    in_base = turned(to_base, *(points - base[:, None]).unbind(-1))
    inside = torch.ones_like(in_base[0], dtype=torch.bool)
    for axis, coordinate in enumerate(in_base):
        inside = inside & (coordinate >= body.lower[axis]) & (coordinate <= body.upper[axis])
    return inside


def anchor_of(position: Float[Tensor, "B 3"], resolution: float) -> Tensor:
    """Return the cell number (B, 2) of a position; float64 first, or it is off by cells 100 km from the origin."""
    return realize(torch.floor(position[:, :2].double() / resolution).to(torch.int64))


def relative_to(position: Float[Tensor, "B ... 3"], anchor: Tensor, resolution: float, dtype: torch.dtype) -> Tensor:
    """Return positions with x and y counted from the anchor cell's corner, in the map's precision."""
    corner = torch.nn.functional.pad(anchor.double() * resolution, (0, 1))
    return realize((position.double() - corner.view(-1, *[1] * (position.ndim - 2), 3)).to(dtype))


def turned(rotation: Float[Tensor, "... 3 3"], x: Tensor, y: Tensor, z: Tensor) -> list[Tensor]:
    """Return the rows of R p. Written out: a matrix product may round otherwise for another batch size."""
    entries = rotation.flatten(-2).unsqueeze(-2).unbind(-1)
    return [a * x + b * y + c * z for a, b, c in (entries[:3], entries[3:6], entries[6:])]


def sound_poses(T_map_sensor: Tensor, T_map_base: Tensor | None) -> tuple[Bool[Tensor, "B"], Tensor, Tensor | None]:
    """Tell which environments' poses are finite and within FARTHEST; return them with zeros in place of the others.

    Where the host may not read poses, and refuse them, one robot's NaN would become an index, and an error of all.
    """
    sound = near(T_map_sensor) if T_map_base is None else near(T_map_sensor) & near(T_map_base)
    sound, T_map_sensor = realize_all(sound, torch.where(sound[:, None, None, None], T_map_sensor, 0.0))
    if T_map_base is not None:
        T_map_base = realize(torch.where(sound[:, None, None], T_map_base, 0.0))
    return sound, T_map_sensor, T_map_base


def near(pose: Float[Tensor, "B ... 4 4"]) -> Bool[Tensor, "B"]:
    """Tell which environments' poses may become cell numbers; NaN may not."""
    return (pose.abs() <= FARTHEST).flatten(1).all(1)


def has_inverse(variance: Tensor) -> Tensor:
    """Tell which variances are positive and finite, and their inverses finite too."""
    return torch.isfinite(variance) & (variance >= torch.finfo(variance.dtype).tiny)


def measure(
    points: Float[Tensor, "B S N 3"],
    T_map_sensor: Float[Tensor, "B S 4 4"],
    T_map_base: Float[Tensor, "B 4 4"] | None,
    dt: Float[Tensor, "B"],
    variance: Float[Tensor, "B S N"] | None,
    grid: GridConfig,
    cfg: SensorConfig,
    dtype: torch.dtype,
) -> Measurement:
    """Turn sensor-frame points into a measurement (paper, Sec. II-A "transform" and II-C).

    Noise: sigma_p^2 = alpha_d * d^2 + floor with d the distance from the sensor, or the caller's variances.
    Gates: not finite, distance, body box, exclusion ramp. An ignored point has used = False. A point is not finite
    either whose variance `has_inverse` refuses, or one of whose environment's poses `sound_poses` does.
    """
    sound, T_map_sensor, T_map_base = sound_poses(T_map_sensor, T_map_base)
    position = T_map_sensor[..., :3, 3]
    anchor = anchor_of(position[:, 0] if T_map_base is None else T_map_base[:, :3, 3], grid.resolution)
    origin = relative_to(position, anchor, grid.resolution, dtype)
    base = None if T_map_base is None else relative_to(T_map_base[:, :3, 3], anchor, grid.resolution, dtype)

    x, y, z = points.to(dtype).unbind(-1)
    largest = torch.maximum(torch.maximum(x.abs(), y.abs()), z.abs())  # NaN where a coordinate is
    finite = (largest < torch.inf) & sound[:, None, None]
    if variance is not None:
        variance = variance.to(dtype)
        finite = finite & has_inverse(variance)
    # Zeroed before any product: 0 * NaN would poison sums and gradients, and so would the square of 1e30.
    small = finite & (largest <= cfg.max_distance)
    x, y, z = (torch.where(small, c, 0.0) for c in (x, y, z))
    square = x * x + y * y + z * z
    valid = small & (square >= cfg.min_distance**2) & (square <= cfg.max_distance**2)
    # Coordinates outermost in memory: the stages read x, y and z apart.
    relative = torch.stack(turned(T_map_sensor[..., :3, :3].to(dtype), x, y, z), 1)
    in_map = relative + origin.transpose(1, 2)[..., None]
    valid, relative, in_map = (t.flatten(-2) for t in realize_all(valid, relative, in_map))
    relative, in_map = relative.transpose(1, 2), in_map.transpose(1, 2)
    finite = finite.flatten(1)

    if variance is None:
        sigma2 = (cfg.noise_factor * square + cfg.noise_floor).flatten(1)
    else:
        sigma2 = torch.where(finite, variance.flatten(1), 1.0)
    body = overhang = torch.zeros_like(valid)
    if cfg.body is not None and base is not None and T_map_base is not None:
        body = valid & inside_body(in_map, T_map_base, base, cfg.body)
    if cfg.exclusion is not None:
        overhang = valid & ~body & above_ramp(relative, cfg.exclusion)
    sigma2, used, casts = realize_all(sigma2, valid & ~body & ~overhang, valid & ~body)
    number_finite, number_valid, number_casts, number_used = (count(mask) for mask in (finite, valid, casts, used))
    return Measurement(
        anchor=anchor,
        points=in_map,
        variance=sigma2,
        used=used,
        casts=casts,
        origin=origin,
        base=base if base is None else realize(torch.where(sound[:, None], base, torch.nan)),
        dt=realize(dt.to(dtype).nan_to_num(0.0, 0.0).clamp(min=0)),
        rejected_invalid=finite.shape[1] - number_finite,
        rejected_range=number_finite - number_valid,
        rejected_body=number_valid - number_casts,
        rejected_overhang=number_casts - number_used,
    )


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
        frame: "optical" has x right, y down, z forward (ROS, OpenCV, RealSense); "opengl" has x right, y up, z
            backward, as the camera poses of MuJoCo and Isaac do.

    Returns:
        Points (..., h * w, 3), row by row; float32 for integers, else in the dtype of the depth.

    Raises:
        ValueError: for another `along` or `frame`, a scale that is missing or not positive, or shapes that do not fit.
        TypeError: for a dtype that holds no depth.
    """
    require(along in ("z", "ray"), "along", 'must be "z" or "ray"', repr(along), 'pinhole depth images are "z"')
    hint = "give the axes of the pose that you pass as T_map_sensor"
    require(frame in ("optical", "opengl"), "frame", 'must be "optical" or "opengl"', repr(frame), hint)
    _check_images(depth, intrinsics)
    depth = _in_metres(depth, scale)
    intrinsics = intrinsics.to(depth)
    v = torch.arange(depth.shape[-2], device=depth.device, dtype=depth.dtype)[:, None]
    u = torch.arange(depth.shape[-1], device=depth.device, dtype=depth.dtype)
    fx, fy, cx, cy = (intrinsics[..., i, j, None, None] for i, j in ((0, 0), (1, 1), (0, 2), (1, 2)))
    x, y = torch.broadcast_tensors((u - cx) / fx, (v - cy) / fy)
    z = torch.ones_like(x)
    rays = torch.stack([x, y, z] if frame == "optical" else [x, -y, -z], -1)
    if along == "ray":
        rays = rays / torch.linalg.vector_norm(rays, dim=-1, keepdim=True)
    hit = torch.isfinite(depth) & (depth > 0)
    return (rays * torch.where(hit, depth, math.nan)[..., None]).flatten(-3, -2)


def _check_images(depth: Tensor, intrinsics: Tensor) -> None:
    """Refuse what are no tensors, and depth images and intrinsics whose shapes do not fit each other."""
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
    if readable(intrinsics):
        focal = intrinsics.detach().diagonal(dim1=-2, dim2=-1)[..., :2]
        wrong = focal[~((focal > 0) & focal.isfinite()).all(-1)]
        rule, hint = "must have positive, finite focal lengths", "give [[fx, 0, cx], [0, fy, cy], [0, 0, 1]] in pixels"
        require(not len(wrong), "intrinsics", rule, wrong[:1].tolist(), hint)


def _in_metres(depth: Tensor, scale: float | None) -> Tensor:
    """Return depth as floats [m]; integers need a scale, as their unit is not known."""
    kind = depth.dtype
    numbers = kind != torch.bool and not kind.is_complex
    require(numbers, "depth", "must be floats or integers", kind, "give metres, or integers and scale=", TypeError)
    known = kind.is_floating_point or scale is not None
    require(known, "scale", "is required for integer depth", "None", "give metres per unit: 0.001 for millimetres")
    if scale is None:
        return depth
    require_positive(scale=scale)
    return (depth if kind.is_floating_point else depth.to(torch.float32)) * scale


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
    means = _voxel_means(points, size)
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
