"""Where a policy reads the map: points around the base or the feet, how they turn, and where they lie in the window."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

import torch
from torch import Tensor

from torchelev.errors import require
from torchelev.grid import GridConfig

if TYPE_CHECKING:
    from jaxtyping import Float, Int

Points = tuple[tuple[float, float], ...]  # x, y [m]

ALIGNMENTS = ("yaw", "base", "world")
STEEPEST = 0.1  # horizontal part of the base's x axis, below which it says nothing about the heading
LEGGED_GYM_X = tuple(k / 10 for k in range(-8, 9))  # [m]
LEGGED_GYM_Y = tuple(k / 10 for k in range(-5, 6))  # [m]
RINGS = ((0.08, 6), (0.16, 8), (0.26, 10), (0.36, 12), (0.48, 16))  # radius [m] and points, as the paper's policy has


def steps(length: float, resolution: float, beyond: float) -> list[float]:
    """Return -length / 2, -length / 2 + resolution, ... below length / 2 + beyond [m], as many as of `torch.arange`."""
    count = math.ceil((length / 2 + beyond + length / 2) / resolution)
    return [-length / 2 + k * resolution for k in range(count)]


def x_fastest(x: Sequence[float], y: Sequence[float]) -> Points:
    """Return the points of a grid, x fastest: Isaac Lab's and mjlab's order."""
    return tuple((a, b) for b in y for a in x)


def y_fastest(x: Sequence[float], y: Sequence[float]) -> Points:
    """Return the points of a grid, y fastest: legged_gym's order, and that of layers, [i, j] -> i * W + j."""
    return tuple((a, b) for a in x for b in y)


def centered(count: int, resolution: float, middle: float) -> list[float]:
    """Return `count` places that are `resolution` apart, around `middle` [m]."""
    return [middle + (k - (count - 1) / 2) * resolution for k in range(count)]


def ring_points(rings: Iterable[tuple[float, int]]) -> Points:
    """Return rings of (radius [m], number of points), one after the other; each starts at +x and turns left."""
    rings = list(rings)
    for ring in rings:
        pair = isinstance(ring, list | tuple) and len(ring) == 2
        good = pair and isinstance(ring[0], int | float) and ring[0] >= 0 and type(ring[1]) is int and ring[1] >= 1
        require(good, "rings", "must be pairs of a radius and a number of points", ring, "give [(0.08, 6), (0.16, 8)]")
    angles = ((radius, 2 * math.pi * k / count) for radius, count in rings for k in range(count))
    return tuple((radius * math.cos(angle), radius * math.sin(angle)) for radius, angle in angles)


def as_points(xy: Any) -> Points:
    """Return what may be a tensor, an array or a list of pairs as points."""
    rows = xy.tolist() if hasattr(xy, "tolist") else xy
    hint = "give (P, 2) numbers, x and y [m] in the base frame"
    try:
        points = tuple((float(x), float(y)) for x, y in rows)
    except (TypeError, ValueError):
        points = ()
    require(len(points) > 0, "pattern", "must be one or more points (x, y)", type(xy).__name__, hint)
    finite = all(math.isfinite(x) and math.isfinite(y) for x, y in points)
    require(finite, "pattern", "must be finite", "NaN or inf", hint)
    return points


def heading(T_map_base: Float[Tensor, "B 4 4"]) -> Float[Tensor, "B 2"]:
    """Return the unit vector (cos, sin) of the base's yaw: its x axis, projected onto the horizontal plane.

    Where that is shorter than 0.1, within 6 degrees of straight up or down, the y axis turned right by 90 degrees
    takes its place, which is horizontal then. Isaac Lab takes the x axis everywhere, mjlab does the same as here.
    legged_gym keeps the z and w of the quaternion: for small angles that differs by roll * pitch / 2 [rad].
    """
    x, y = T_map_base[:, :2, 0], T_map_base[:, :2, 1]
    level = torch.linalg.vector_norm(x.detach(), dim=-1, keepdim=True) >= STEEPEST
    # By slices: a list as an index would copy it to the device.
    forward = torch.where(level, x, torch.cat([y[:, 1:], -y[:, :1]], -1))
    return forward / torch.linalg.vector_norm(forward, dim=-1, keepdim=True)


def grid_coordinates(
    xyz: Float[Tensor, "B K 3"], corner: Int[Tensor, "B 2"], resolution: float, dtype: torch.dtype
) -> Float[Tensor, "B K 2"]:
    """Return places, map frame [m], in cells from the window's corner; differenced in float64."""
    return (xyz[..., :2].double() / resolution - corner[:, None]).to(dtype)


@dataclass(frozen=True)
class Pattern:
    """Points that move with a robot. Their constants lie on the device of the map, from the first call there on."""

    points: Points  #: (M, 2) or (M, 3) [m] in the aligned frame
    alignment: str = "yaw"  #: how the points turn with the robot
    reach: float = 0.0  #: [m] how far from the base the patterns' middles may lie
    span: tuple[float, float] = field(init=False)  #: [m] how far along x and y points may lie from the base
    #: the points on each device and in each dtype asked for so far
    tensors: dict[tuple[torch.device, torch.dtype], Tensor] = field(
        init=False, default_factory=dict, repr=False, compare=False
    )

    def __post_init__(self) -> None:
        known = self.alignment in ALIGNMENTS
        require(known, "alignment", f"must be one of {', '.join(ALIGNMENTS)}", repr(self.alignment), "use yaw")
        radius = max(math.hypot(x, y) for x, y in self.points)
        x, y = (max(abs(point[axis]) for point in self.points) for axis in (0, 1))
        turns = self.alignment != "world"
        span = (self.reach + radius,) * 2 if turns else (self.reach + x, self.reach + y)
        object.__setattr__(self, "span", span)

    def require_inside(self, grid: GridConfig) -> None:
        """Refuse a map whose window is too small for the points, whatever the heading.

        The base lies at the window's centre within half a cell, and what is read around a point is another half.
        """
        need = [2 * (span + grid.resolution) for span in self.span]
        if need[0] <= grid.length_x + 1e-9 and need[1] <= grid.length_y + 1e-9:
            return  # before a message is made
        actual = f"a window of {grid.length_x:g} x {grid.length_y:g} m"
        rule = f"must lie in the map at any heading, which takes {need[0]:.3g} x {need[1]:.3g} m"
        require(False, "pattern", rule, actual, "enlarge length_x and length_y of GridConfig, or shrink the pattern")

    def cells(self, grid: GridConfig) -> tuple[int, int]:
        """Return how many cells along x and y from the window's centre are read, at most."""
        along_x, along_y = (math.ceil(span / grid.resolution) + 1 for span in self.span)
        return along_x, along_y

    def on(self, device: torch.device, dtype: torch.dtype) -> Float[Tensor, "P 2"]:
        """Return the points as a tensor; it is copied to a device once."""
        found = self.tensors.get((device, dtype))
        if found is not None:
            return found
        if torch.compiler.is_compiling():
            return torch.tensor(self.points, dtype=dtype, device=device)
        return self.tensors.setdefault((device, dtype), torch.tensor(self.points, dtype=dtype, device=device))

    def place(
        self,
        T_map_base: Float[Tensor, "B 4 4"],
        middle: Float[Tensor, "B K 3"],
        corner: Int[Tensor, "B 2"],
        resolution: float,
        dtype: torch.dtype,
    ) -> Float[Tensor, "B M 2"]:
        """Return the points around K middles, map frame [m], in cells from the window's corner; M = K * P.

        Middles are differenced in float64, so that float32 keeps the rest exact far from the origin.
        """
        start = grid_coordinates(middle, corner, resolution, dtype)
        offset = self.on(T_map_base.device, dtype) / resolution
        if self.alignment == "world":
            return (start[:, :, None] + offset).flatten(1, 2)
        x, y = offset[:, None].unbind(-1)
        ahead, left = (axis.to(dtype)[:, None] for axis in self._axes(T_map_base))
        # In single products: a matrix product may be rounded to ten bits on a GPU.
        turned = torch.addcmul(x * ahead, y, left)
        return (start[:, :, None] + turned[:, None]).flatten(1, 2)

    def _axes(self, T_map_base: Float[Tensor, "B 4 4"]) -> tuple[Tensor, Tensor]:
        """Return where the pattern's x and y axes point, (B, 2) each."""
        if self.alignment == "base":
            return T_map_base[:, :2, 0], T_map_base[:, :2, 1]
        ahead = heading(T_map_base)
        return ahead, torch.cat([-ahead[:, 1:], ahead[:, :1]], -1)
