"""The points on the robot's links in C++ (`own_points.cpp`), for updates on a CPU: the same as by tensors."""

from __future__ import annotations

import ctypes
import functools
import math
from typing import TYPE_CHECKING

import torch
from torch import Tensor

from torchelev.kernels.cpu_build import call, load
from torchelev.robot_body.posing import rotation_rows
from torchelev.robot_body.shapes import RobotBody

if TYPE_CHECKING:
    from jaxtyping import Bool, Float

LIBRARY: tuple[str, dict[str, str]] = ("robot_body/kernel/own_points.cpp", {})


class _Body(ctypes.Structure):
    """`Body` of own_points.h."""

    _fields_ = (
        *((name, ctypes.c_void_p) for name in ("capsules", "boxes")),
        *((name, ctypes.c_int64) for name in ("num_capsules", "num_boxes")),
        ("depth_tolerance", ctypes.c_float),
    )


class _OwnPoints(ctypes.Structure):
    """`OwnPoints` of own_points.cpp."""

    _fields_ = (
        *((name, ctypes.c_void_p) for name in ("points", "T_map_sensor", "T_map_base", "T_base_links", "own")),
        ("body", _Body),
        *((name, ctypes.c_int64) for name in "BSNK"),
    )


def _floats(rows: list[list[float]]) -> Tensor:
    return torch.tensor(rows, dtype=torch.float32, device="cpu")


@functools.lru_cache(maxsize=64)
def _packed(body: RobotBody) -> tuple[Tensor, Tensor]:
    """Return the shapes as C++ takes them: capsules (P, 9) and boxes (Q, 16), float32."""
    capsules = [
        [body.links.index(c.link), *c.start, *(e - s for s, e in zip(c.start, c.end, strict=True))]
        + [math.dist(c.start, c.end) ** 2, (c.radius + body.padding) ** 2]
        for c in body.capsules
    ]
    boxes = [
        [body.links.index(b.link), *b.center, *rotation_rows(b.quat_wxyz), *(h + body.padding for h in b.half_lengths)]
        for b in body.boxes
    ]
    return _floats(capsules), _floats(boxes)


def find_own_points(
    points: Float[Tensor, "B S N 3"],
    T_map_sensor: Float[Tensor, "B S 4 4"],
    T_map_base: Float[Tensor, "B 4 4"],
    T_base_links: Float[Tensor, "B K 4 4"],
    body: RobotBody,
) -> Bool[Tensor, "B S N"] | None:
    """Return which points of the sensors' frames lie on the robot; None without a library."""
    library = load(*LIBRARY)
    if library is None:
        return None
    B, S, N = points.shape[:3]
    points = points.float().contiguous()
    poses = [T.double().contiguous() for T in (T_map_sensor, T_map_base, T_base_links)]
    own = torch.empty(B, S, N, dtype=torch.bool, device=points.device)
    capsules, boxes = _packed(body)
    shapes = _Body(capsules.data_ptr(), boxes.data_ptr(), len(capsules), len(boxes), body.depth_tolerance)
    addresses = (value.data_ptr() for value in (points, *poses, own))
    call(
        library.find_own_points,
        ctypes.byref(_OwnPoints(*addresses, shapes, B, S, N, len(body.links))),
        torch.get_num_threads(),
    )
    return own
