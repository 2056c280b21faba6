"""The shapes of a robot in the frames of its sensors, at one instant."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, NamedTuple

import torch
from torch import Tensor

from torchelev.robot_body.shapes import RobotBody

if TYPE_CHECKING:
    from jaxtyping import Float


class PosedBody(NamedTuple):
    """P capsules and Q boxes seen from S sensors, which are the origins of their frames."""

    start: Float[Tensor, "3 B S P"]  #: [m] a of the axes from a to a + e, sensor frame
    axis: Float[Tensor, "3 B S P"]  #: [m] e, sensor frame
    start_start: Float[Tensor, "B S P"]  #: [m^2] a . a
    start_axis: Float[Tensor, "B S P"]  #: [m^2] a . e
    to_box: Float[Tensor, "3 3 B S Q"]  #: takes directions of the sensor frame into the boxes' axes
    origin: Float[Tensor, "3 B S Q"]  #: [m] the sensor, in the boxes' axes


def dot(a: Sequence[Tensor] | Tensor, b: Sequence[Tensor] | Tensor) -> Tensor:
    """Return a . b of vectors whose coordinates come first. Written out: a sum may round otherwise in a batch."""
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


def _turn(rotation: Tensor, vectors: Sequence[Tensor] | Tensor) -> list[Tensor]:
    """Return the coordinates of R v for rotations (3, 3, ...)."""
    return [dot(rotation[row], vectors) for row in range(3)]


def _coordinates_first(T: Float[Tensor, "*B 4 4"]) -> tuple[Tensor, Tensor]:
    """Return rotations (3, 3, ...) and positions (3, ...) of poses."""
    return T[..., :3, :3].movedim((-2, -1), (0, 1)), T[..., :3, 3].movedim(-1, 0)


def _constant(rows: Sequence[Sequence[float]], like: Tensor) -> Float[Tensor, "n P"]:
    """Return numbers (P, n) as a tensor (n, P). Filled, not copied from the host, which a GPU would wait for."""
    return torch.stack([torch.stack([like.new_full((), value) for value in row]) for row in zip(*rows, strict=True)])


def rotation_rows(quat_wxyz: tuple[float, float, float, float]) -> list[float]:
    """Return the nine entries of a quaternion's rotation matrix, row by row."""
    w, x, y, z = quat_wxyz
    return [
        *(1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)),
        *(2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)),
        *(2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)),
    ]


def relative_pose(
    T_a_sensor: Float[Tensor, "B S 4 4"], T_a_base: Float[Tensor, "B 4 4"], dtype: torch.dtype
) -> Float[Tensor, "B S 4 4"]:
    """Return T_sensor_base from both poses in a frame a; differenced in float64, as a's origin may be 100 km away."""
    R_sensor, t_sensor = _coordinates_first(T_a_sensor.double())
    R_base, t_base = _coordinates_first(T_a_base[:, None].double())
    to_sensor = R_sensor.transpose(0, 1)
    columns = [torch.stack(_turn(to_sensor, vector)) for vector in (*R_base.unbind(1), t_base - t_sensor)]
    rows = torch.stack(columns, 1)
    last = torch.zeros_like(rows[:1])
    return torch.cat([rows, last]).movedim((0, 1), (-2, -1)).to(dtype)


def pose_body(
    body: RobotBody, T_sensor_base: Float[Tensor, "B S 4 4"], T_base_links: Float[Tensor, "B K 4 4"]
) -> PosedBody:
    """Return the shapes in the sensors' frames. Both poses have the dtype of the result, which has no gradient."""
    T_sensor_base, T_base_links = T_sensor_base.detach(), T_base_links.detach()
    start, axis = _pose_capsules(body, T_sensor_base, T_base_links)
    to_box, origin = _pose_boxes(body, T_sensor_base, T_base_links)
    return PosedBody(start, axis, dot(start, start), dot(start, axis), to_box, origin)


def _links_of(shapes: Sequence, body: RobotBody, T_base_links: Tensor) -> tuple[Tensor, Tensor]:
    """Return rotations (3, 3, B, 1, P) and positions (3, B, 1, P) of the links of P shapes."""
    links = T_base_links.unbind(1)
    T = torch.stack([links[body.links.index(shape.link)] for shape in shapes], 1)
    return _coordinates_first(T[:, None])


def _pose_capsules(body: RobotBody, T_sensor_base: Tensor, T_base_links: Tensor) -> tuple[Tensor, Tensor]:
    """Return the capsules' a and e (3, B, S, P)."""
    if not body.capsules:
        none = T_sensor_base.new_zeros((3, *T_sensor_base.shape[:2], 0))
        return none, none
    R_base, t_base = (value[..., None] for value in _coordinates_first(T_sensor_base))
    R_link, t_link = _links_of(body.capsules, body, T_base_links)
    start = _constant([capsule.start for capsule in body.capsules], T_sensor_base)
    axis = _constant([[e - s for s, e in zip(c.start, c.end, strict=True)] for c in body.capsules], T_sensor_base)
    in_base = [rotated + offset for rotated, offset in zip(_turn(R_link, start), t_link, strict=True)]
    return torch.stack(_turn(R_base, in_base)) + t_base, torch.stack(_turn(R_base, _turn(R_link, axis)))


def _pose_boxes(body: RobotBody, T_sensor_base: Tensor, T_base_links: Tensor) -> tuple[Tensor, Tensor]:
    """Return the boxes' rotations (3, 3, B, S, Q), and the sensors in their axes (3, B, S, Q)."""
    if not body.boxes:
        none = T_sensor_base.new_zeros((3, 3, *T_sensor_base.shape[:2], 0))
        return none, none[0]
    R_base, t_base = (value[..., None] for value in _coordinates_first(T_sensor_base))
    R_link, t_link = _links_of(body.boxes, body, T_base_links)
    center = _constant([box.center for box in body.boxes], T_sensor_base)
    turned = _constant([rotation_rows(box.quat_wxyz) for box in body.boxes], T_sensor_base).unflatten(0, (3, 3))
    in_base = [rotated + offset for rotated, offset in zip(_turn(R_link, center), t_link, strict=True)]
    in_sensor = torch.stack(_turn(R_base, in_base)) + t_base
    # The box's axes are the columns of R_base R_link R_box, and the rows of the matrix that takes directions into them.
    to_box = torch.stack([torch.stack(_turn(R_base, _turn(R_link, turned[:, axis]))) for axis in range(3)])
    return to_box, -torch.stack(_turn(to_box, in_sensor))
