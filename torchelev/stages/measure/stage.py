"""From a sensor's points to a measurement: transform, gates, noise."""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

import torch
from torch import Tensor

from torchelev.grid import GridConfig
from torchelev.inputs.checks import FARTHEST
from torchelev.inputs.update_inputs import Inputs
from torchelev.ops.masks import count
from torchelev.robot_body import own_kernel
from torchelev.robot_body.shapes import RobotBody
from torchelev.stages.measure.body import inside_body, on_robot, rotate
from torchelev.stages.measure.config import BodyConfig, ExclusionConfig, SensorConfig
from torchelev.stages.measure.depth import add_depth_noise, from_ramp
from torchelev.stages.pose_error import project_covariance
from torchelev.state import Measurement

if TYPE_CHECKING:
    from jaxtyping import Bool, Float, Int


def above_ramp(relative: Float[Tensor, "B M 3"], ramp: ExclusionConfig) -> Bool[Tensor, "B M"]:
    """Return which points lie in the exclusion area (paper, Sec. II-C and Fig. 3).

    z - z_s > min(max(r - b, 0) * tan(theta_a) + c, d), with r the horizontal distance from the sensor.
    `relative` is the point less the sensor's position, in map axes [m].
    """
    r = (relative[..., 0].square() + relative[..., 1].square()).clamp(min=1e-12).sqrt()
    limit = ((r - ramp.distance).clamp(min=0) * ramp.slope + ramp.offset).clamp(max=ramp.height)
    return relative[..., 2] > limit


def anchor_of(position: Float[Tensor, "B 3"], resolution: float) -> Int[Tensor, "B 2"]:
    """Return the cell number of a position; in float64, or it is off by cells 100 km from the origin."""
    return torch.floor(position[:, :2].double() / resolution).to(torch.int64)


def relative_to(position: Float[Tensor, "B ... 3"], anchor: Tensor, resolution: float, dtype: torch.dtype) -> Tensor:
    """Return positions with x and y counted from the anchor cell's corner, in the map's precision."""
    corner = torch.nn.functional.pad(anchor.double() * resolution, (0, 1))
    return (position.double() - corner.view(-1, *[1] * (position.ndim - 2), 3)).to(dtype)


def sound_poses(
    T_map_sensor: Tensor, T_map_base: Tensor | None, T_base_links: Tensor | None
) -> tuple[Bool[Tensor, "B"], Tensor, Tensor | None, Tensor | None]:
    """Return which environments' poses are finite and within FARTHEST; return all, with zeros in place of unsound ones.

    Where the host may not read poses, it cannot refuse them: a robot's NaN would become an index out of range.
    """
    sound = is_near(T_map_sensor)
    for pose in (T_map_base, T_base_links):
        sound = sound if pose is None else sound & is_near(pose)
    T_map_sensor = torch.where(sound[:, None, None, None], T_map_sensor, 0.0)
    if T_map_base is not None:
        T_map_base = torch.where(sound[:, None, None], T_map_base, 0.0)
    if T_base_links is not None:
        T_base_links = torch.where(sound[:, None, None, None], T_base_links, 0.0)
    return sound, T_map_sensor, T_map_base, T_base_links


def is_near(pose: Float[Tensor, "B ... 4 4"]) -> Bool[Tensor, "B"]:
    """Return which environments' poses may become cell numbers; NaN may not."""
    return (pose.abs() <= FARTHEST).flatten(1).all(1)


def has_inverse(variance: Tensor) -> Tensor:
    """Return which variances are positive and finite, and their inverses finite too."""
    return torch.isfinite(variance) & (variance >= torch.finfo(variance.dtype).tiny)


class SensorPoints(NamedTuple):
    """The points in their sensors' axes."""

    x: Float[Tensor, "B S N"]  #: [m] 0 where not finite or too far, as are y and z
    y: Float[Tensor, "B S N"]  #: [m]
    z: Float[Tensor, "B S N"]  #: [m]
    distance2: Float[Tensor, "B S N"]  #: [m^2] d^2, squared distance from the sensor
    finite: Bool[Tensor, "B S N"]  #: the point and its variance, in an environment of sound poses
    in_range: Bool[Tensor, "B S N"]  #: finite, and neither too near nor too far


def gate_range(
    points: Float[Tensor, "B S N 3"], variance: Tensor | None, sound: Bool[Tensor, "B"], cfg: SensorConfig
) -> SensorPoints:
    """Find the points that are finite and as far from the sensor as it measures."""
    x, y, z = points.unbind(-1)
    largest = torch.maximum(torch.maximum(x.abs(), y.abs()), z.abs())  # NaN where a coordinate is
    finite = (largest < torch.inf) & sound[:, None, None]
    if variance is not None:
        finite = finite & has_inverse(variance)
    # Zeroed before any product: 0 * NaN would poison sums and gradients, and so would the square of 1e30.
    small = finite & (largest <= cfg.max_distance)
    x, y, z = (torch.where(small, c, 0.0) for c in (x, y, z))
    d2 = x * x + y * y + z * z
    return SensorPoints(x, y, z, d2, finite, small & (d2 >= cfg.min_distance**2) & (d2 <= cfg.max_distance**2))


class MapPoints(NamedTuple):
    """The points of all sensors in map axes, M = S * N."""

    in_range: Bool[Tensor, "B M"]  #: neither too near nor too far
    relative: Float[Tensor, "B 3 M"]  #: [m] from the sensor
    position: Float[Tensor, "B 3 M"]  #: [m] from the measurement's anchor


def transform(points: SensorPoints, rotation: Float[Tensor, "B S 3 3"], origin: Float[Tensor, "B S 3"]) -> MapPoints:
    """Take points from their sensors' axes into the map's, p = R p_s + t (paper, Sec. II-A)."""
    relative = torch.stack(rotate(rotation, points.x, points.y, points.z), 1)
    position = relative + origin.transpose(1, 2)[..., None]
    return MapPoints(*(t.flatten(-2) for t in (points.in_range, relative, position)))


class Gates(NamedTuple):
    """What is done with each point."""

    variance: Float[Tensor, "B M"]  #: [m^2] sigma_p^2 of its height
    used: Bool[Tensor, "B M"]  #: measures the ground
    casts: Bool[Tensor, "B M"]  #: its ray clears and bounds cells


def gate_points(
    sensed: SensorPoints,
    mapped: MapPoints,
    variance: Tensor | None,
    T_map_base: Tensor | None,
    base: Tensor | None,
    own: Bool[Tensor, "B S N"] | None,
    aside: Bool[Tensor, "B S N"] | None,
    cfg: SensorConfig,
    resolution: float,
) -> Gates:
    """Leave out points on the body, above the ramp or on other surfaces; sigma_p^2 = alpha_d d^2 + noise_floor."""
    relative, position = mapped.relative.transpose(1, 2), mapped.position.transpose(1, 2)
    if variance is None:
        noise = cfg.noise_factor * sensed.distance2 + cfg.noise_floor
        variance = add_depth_noise(noise, sensed.z, cfg.depth).flatten(1)
    else:
        variance = torch.where(sensed.finite, variance, 1.0).flatten(1)
    body = overhang = torch.zeros_like(mapped.in_range)
    if own is not None:
        body = own.flatten(1)
    elif isinstance(cfg.body, BodyConfig) and base is not None and T_map_base is not None:
        body = mapped.in_range & inside_body(position, T_map_base, base, cfg.body)
    if cfg.exclusion is not None:
        place = from_ramp(position, relative, base, cfg.depth, resolution)
        overhang = mapped.in_range & ~body & above_ramp(place, cfg.exclusion)
    if aside is not None:
        overhang = overhang | (mapped.in_range & ~body & aside.flatten(1))
    return Gates(variance, mapped.in_range & ~body & ~overhang, mapped.in_range & ~body)


def time_step(dt: Tensor, dtype: torch.dtype) -> Float[Tensor, "B"]:
    """Return dt [s]; no time passes where it is not finite or negative."""
    return dt.to(dtype).nan_to_num(0.0, 0.0).clamp(min=0)


def nan_where_unsound(base: Float[Tensor, "B 3"], sound: Bool[Tensor, "B"]) -> Float[Tensor, "B 3"]:
    """Return the base's position, NaN in environments without a sound pose: their windows stay."""
    return torch.where(sound[:, None], base, torch.nan)


def measure(
    points: Float[Tensor, "B S N 3"],
    T_map_sensor: Float[Tensor, "B S 4 4"],
    T_map_base: Float[Tensor, "B 4 4"] | None,
    dt: Float[Tensor, "B"],
    variance: Float[Tensor, "B S N"] | None,
    T_base_links: Float[Tensor, "B K 4 4"] | None,
    pose_covariance: Float[Tensor, "B S 6 6"] | None,
    moving: Bool[Tensor, "B"] | None,
    aside: Bool[Tensor, "B S N"] | None,
    grid: GridConfig,
    cfg: SensorConfig,
    dtype: torch.dtype,
) -> Measurement:
    """Turn sensor-frame points into a measurement (paper, Sec. II-A "transform" and II-C).

    Noise: sigma_p^2 = alpha_d * d^2 + noise_floor with d the distance from the sensor, or the caller's variances.
    Gates: not finite, distance, the robot's body, exclusion ramp, other surfaces (`aside`). Rejected points have used =
    False. A point counts as not finite if its variance has no finite inverse, or if a pose of its environment is not
    finite or beyond FARTHEST.
    """
    sound, T_map_sensor, T_map_base, T_base_links = sound_poses(T_map_sensor, T_map_base, T_base_links)
    position = T_map_sensor[..., :3, 3]
    anchor = anchor_of(position[:, 0] if T_map_base is None else T_map_base[:, :3, 3], grid.resolution)
    origin = relative_to(position, anchor, grid.resolution, dtype)
    base = None if T_map_base is None else relative_to(T_map_base[:, :3, 3], anchor, grid.resolution, dtype)
    variance = None if variance is None else variance.to(dtype)
    sensed = gate_range(points.to(dtype), variance, sound, cfg)
    mapped = transform(sensed, T_map_sensor[..., :3, :3].to(dtype), origin)
    own = None
    if isinstance(cfg.body, RobotBody) and T_map_base is not None and T_base_links is not None:
        own = on_links(sensed, T_map_sensor, T_map_base, T_base_links, cfg.body)
    gates = gate_points(sensed, mapped, variance, T_map_base, base, own, aside, cfg, grid.resolution)
    total, noise, of_position = gates.variance, None, None
    if pose_covariance is not None:
        total, noise = gates.variance + project_covariance(mapped.relative, pose_covariance, dtype), gates.variance
        of_position = pose_covariance[:, 0, :3, :3].to(dtype)
    finite, in_range, casts, used = (count(mask) for mask in (sensed.finite, mapped.in_range, gates.casts, gates.used))
    return Measurement(
        anchor=anchor,
        points=mapped.position.transpose(1, 2),
        variance=total,
        used=gates.used,
        casts=gates.casts,
        origin=origin,
        base=None if base is None else nan_where_unsound(base, sound),
        dt=time_step(dt, dtype),
        rejected_invalid=points.shape[1] * points.shape[2] - finite,
        rejected_range=finite - in_range,
        rejected_body=in_range - casts,
        rejected_overhang=casts - used,
        noise=noise,
        pose_covariance=of_position,
        moving=moving,
    )


def set_aside(m: Measurement, aside: Bool[Tensor, "B M"]) -> Measurement:
    """Return the measurement without points on other surfaces than the ground, as if `measure` had got `aside`."""
    used = m.used & ~aside
    return m._replace(used=used, rejected_overhang=m.rejected_overhang + count(m.used) - count(used))


def on_links(
    sensed: SensorPoints, T_map_sensor: Tensor, T_map_base: Tensor, T_base_links: Tensor, body: RobotBody
) -> Bool[Tensor, "B S N"]:
    """Return which points lie on the robot's links."""
    coordinates = sensed.x, sensed.y, sensed.z, sensed.distance2
    return on_robot(*coordinates, T_map_sensor, T_map_base, T_base_links, body)


def find_own(inputs: Inputs, cfg: SensorConfig) -> Bool[Tensor, "B S N"] | None:
    """Return which points of an update's inputs lie on the robot's links; None for a body without links.

    For compiled updates, of points without gradients; of points out of range, it does not matter.
    """
    if not isinstance(cfg.body, RobotBody):
        return None
    sound, T_map_sensor, T_map_base, T_base_links = sound_poses(
        inputs.T_map_sensor, inputs.T_map_base, inputs.T_base_links
    )
    assert T_map_base is not None and T_base_links is not None
    if inputs.points.is_cpu:
        own = own_kernel.find_own_points(inputs.points, T_map_sensor, T_map_base, T_base_links, cfg.body)
        if own is not None:
            return own
    sensed = gate_range(inputs.points.float(), None, sound, cfg)
    return on_links(sensed, T_map_sensor, T_map_base, T_base_links, cfg.body)
