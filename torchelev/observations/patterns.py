"""Points of observations: their order, how they turn with the robot, and where they lie in the window."""

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
_MIN_HORIZONTAL = 0.1  # horizontal length of the base's x axis below which it does not define the heading


def space_by_arange(length: float, resolution: float, margin: float) -> list[float]:
    """Return the coordinates [m] of `torch.arange(-length / 2, length / 2 + margin, resolution)`."""
    count = math.ceil((length / 2 + margin + length / 2) / resolution)
    return [-length / 2 + k * resolution for k in range(count)]


def space_around(middle: float, count: int, resolution: float) -> list[float]:
    """Return `count` coordinates [m], `resolution` apart, centred on `middle`."""
    return [middle + (k - (count - 1) / 2) * resolution for k in range(count)]


def order_x_fastest(x: Sequence[float], y: Sequence[float]) -> Points:
    """Return the points of a grid in the order of Isaac Lab and mjlab: point (x_i, y_j) at j * len(x) + i."""
    return tuple((a, b) for b in y for a in x)


def order_y_fastest(x: Sequence[float], y: Sequence[float]) -> Points:
    """Return the points of a grid in the order of legged_gym and of layers: point (x_i, y_j) at i * len(y) + j."""
    return tuple((a, b) for a in x for b in y)


def place_rings(rings: Iterable[tuple[float, int]]) -> Points:
    """Return the points of rings (radius [m], number of points), one ring after the other, each from +x to the left."""
    rings = list(rings)
    for ring in rings:
        is_pair = isinstance(ring, list | tuple) and len(ring) == 2
        is_ring = is_pair and isinstance(ring[0], int | float) and ring[0] >= 0 and type(ring[1]) is int
        hint = "give [(0.08, 6), (0.16, 8)]"
        require(is_ring and ring[1] >= 1, "rings", "must be pairs of a radius and a number of points", ring, hint)
    angles = ((radius, 2 * math.pi * k / count) for radius, count in rings for k in range(count))
    return tuple((radius * math.cos(angle), radius * math.sin(angle)) for radius, angle in angles)


def parse_points(xy: Any) -> Points:
    """Check a tensor, an array or a list of points (P, 2) and return it as tuples."""
    rows = xy.tolist() if hasattr(xy, "tolist") else xy
    hint = "give (P, 2) numbers, x and y [m] in the base frame"
    try:
        points = tuple((float(x), float(y)) for x, y in rows)
    except (TypeError, ValueError):
        points = ()
    require(len(points) > 0, "pattern", "must be one or more points (x, y)", type(xy).__name__, hint)
    is_finite = all(math.isfinite(x) and math.isfinite(y) for x, y in points)
    require(is_finite, "pattern", "must be finite", "NaN or inf", hint)
    return points


def compute_heading(T_map_base: Float[Tensor, "B 4 4"]) -> Float[Tensor, "B 2"]:
    """Compute the heading (cos yaw, sin yaw) of the base: its x axis, projected onto the horizontal plane.

    If the x axis is within 6 degrees of the vertical, where its projection is shorter than 0.1, the y axis, turned
    right by 90 degrees, replaces it. mjlab does the same; Isaac Lab uses the x axis always. legged_gym uses z and w of
    the quaternion, which for small angles differs by roll * pitch / 2 [rad].
    """
    x, y = T_map_base[:, :2, 0], T_map_base[:, :2, 1]
    is_level = torch.linalg.vector_norm(x.detach(), dim=-1, keepdim=True) >= _MIN_HORIZONTAL
    # By slices: a list as an index would be copied to the device.
    forward = torch.where(is_level, x, torch.cat([y[:, 1:], -y[:, :1]], -1))
    return forward / torch.linalg.vector_norm(forward, dim=-1, keepdim=True)


def to_cells(
    xyz: Float[Tensor, "B K 3"], corner: Int[Tensor, "B 2"], resolution: float, dtype: torch.dtype
) -> Float[Tensor, "B K 2"]:
    """Convert points [m], map frame, to cells from the window's corner; subtracts in float64."""
    return (xyz[..., :2].double() / resolution - corner[:, None]).to(dtype)


@dataclass(frozen=True)
class Pattern:
    """Points that move with a robot. Their tensor is created once for each device."""

    points: Points  #: (P, 2) [m] in the aligned frame
    alignment: str = "yaw"  #: how the points turn with the robot: "yaw", "base" or "world"
    reach: float = 0.0  #: [m] largest distance of the pattern's origin from the base along x or y
    span: tuple[float, float] = field(init=False)  #: [m] largest distance of a point from the base along x and y
    #: the points on each device and in each dtype used so far
    tensors: dict[tuple[torch.device, torch.dtype], Tensor] = field(
        init=False, default_factory=dict, repr=False, compare=False
    )

    def __post_init__(self) -> None:
        is_known = self.alignment in ALIGNMENTS
        require(is_known, "alignment", f"must be one of {', '.join(ALIGNMENTS)}", repr(self.alignment), "use yaw")
        radius = max(math.hypot(x, y) for x, y in self.points)
        x, y = (max(abs(point[axis]) for point in self.points) for axis in (0, 1))
        turns = self.alignment != "world"
        span = (self.reach + radius,) * 2 if turns else (self.reach + x, self.reach + y)
        object.__setattr__(self, "span", span)

    def require_inside(self, grid: GridConfig) -> None:
        """Refuse a window that cannot hold the points at every heading.

        The base is within half a cell of the window's centre, and reading a point takes another half.
        """
        length_x, length_y = (2 * (span + grid.resolution) for span in self.span)
        if length_x <= grid.length_x + 1e-9 and length_y <= grid.length_y + 1e-9:
            return  # before the message is composed
        actual = f"a window of {grid.length_x:g} x {grid.length_y:g} m"
        rule = f"must lie in the map at any heading, which takes {length_x:.3g} x {length_y:.3g} m"
        require(False, "pattern", rule, actual, "enlarge length_x and length_y of GridConfig, or shrink the pattern")

    def half_extent(self, grid: GridConfig) -> tuple[int, int]:
        """Return how many cells along x and y from the window's centre may be read."""
        along_x, along_y = (math.ceil(span / grid.resolution) + 1 for span in self.span)
        return along_x, along_y

    def on(self, device: torch.device, dtype: torch.dtype) -> Float[Tensor, "P 2"]:
        """Return the points as a tensor, copied to each device once."""
        found = self.tensors.get((device, dtype))
        if found is not None:
            return found
        if torch.compiler.is_compiling():
            return torch.tensor(self.points, dtype=dtype, device=device)
        return self.tensors.setdefault((device, dtype), torch.tensor(self.points, dtype=dtype, device=device))

    def place(
        self,
        T_map_base: Float[Tensor, "B 4 4"],
        origin: Float[Tensor, "B K 3"],
        corner: Int[Tensor, "B 2"],
        resolution: float,
        dtype: torch.dtype,
    ) -> Float[Tensor, "B M 2"]:
        """Place the pattern around K origins [m], map frame, in cells from the window's corner; M = K * P.

        Origins are subtracted in float64, so that float32 suffices for the rest far from the map's origin.
        """
        start = to_cells(origin, corner, resolution, dtype)
        offset = self.on(T_map_base.device, dtype) / resolution
        if self.alignment == "world":
            return (start[:, :, None] + offset).flatten(1, 2)
        x, y = offset[:, None].unbind(-1)
        forward, left = (axis.to(dtype)[:, None] for axis in self._axes(T_map_base))
        # Elementwise: a GPU may round a matrix product to ten bits.
        turned = torch.addcmul(x * forward, y, left)
        return (start[:, :, None] + turned[:, None]).flatten(1, 2)

    def _axes(self, T_map_base: Float[Tensor, "B 4 4"]) -> tuple[Tensor, Tensor]:
        """Return the horizontal parts (B, 2) of the pattern's x and y axes."""
        if self.alignment == "base":
            return T_map_base[:, :2, 0], T_map_base[:, :2, 1]
        forward = compute_heading(T_map_base)
        return forward, torch.cat([-forward[:, 1:], forward[:, :1]], -1)
