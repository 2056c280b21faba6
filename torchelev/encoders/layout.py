"""Which observation groups an encoder reads, and where their values lie."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import torch
from torch import Tensor

from torchelev.encoders.encoder_config import AttentionConfig
from torchelev.errors import require
from torchelev.observations import patterns
from torchelev.observations.height_scan import HeightScan


class MapLayout(NamedTuple):
    """The input of an encoder: C channels of points on R x S cells; R is 1 for a scan that is not a grid."""

    groups: tuple[str, ...]  #: observation groups, whose channels follow each other
    channels: int  #: C, a validity of its own group included
    coordinates: Tensor  #: (F, R, S) constant features of the points: x and y [m], then the further columns of the rows
    validity: int | None  #: the channel that holds the validity

    @classmethod
    def find(cls, name: str, cfg: AttentionConfig, shapes: Mapping[str, Sequence[int]]) -> MapLayout:
        """Find out how to read the observation group `name`.

        Args:
            name: the group.
            cfg: its settings.
            shapes: the shapes of the groups that the model reads, without their first dimension B.

        Raises:
            ValueError: naming the setting that does not fit the group.
        """
        shape, hint = tuple(shapes[name]), "give it as one of these"
        is_map = 1 <= len(shape) <= 3
        require(is_map, name, "must be a group (B, P), (B, C, P) or (B, C, H, W)", ("B", *shape), hint)
        channels = 1 if len(shape) == 1 else shape[0]
        coordinates = _place_pixels(cfg, shape[1:]) if len(shape) == 3 else _place_points(cfg, shape[-1])
        fits = all(size % cfg.patch == 0 for size in coordinates.shape[1:])
        rule = f"must divide the {coordinates.shape[1]} x {coordinates.shape[2]} points"
        require(fits, "patch", rule, cfg.patch, "use 1, or crop the image")
        if isinstance(cfg.validity, str):
            _check_validity_group(cfg.validity, shapes, coordinates[0].numel())
            return cls((name, cfg.validity), channels + 1, coordinates, channels)
        is_channel, hint = cfg.validity is None or 0 <= cfg.validity < channels, "name its channel, or its own group"
        require(is_channel, "validity", f"must be one of the group's {channels} channels", cfg.validity, hint)
        return cls((name,), channels, coordinates, cfg.validity)


def describe_points(points: Any) -> Tensor:
    """Return the constant features (P, F) of the points of a scan: x and y [m]; around feet also which foot it is.

    Args:
        points: name of a preset, a `HeightScan`, or rows (P, F) of numbers.
    """
    scan = HeightScan.preset(points) if isinstance(points, str) else points
    if isinstance(scan, HeightScan):
        xy, feet = torch.tensor(scan.pattern), torch.eye(scan.num_feet)
        around = [xy.repeat(max(1, scan.num_feet), 1), feet.repeat_interleave(len(xy), 0)]
        return torch.cat(around if scan.num_feet else around[:1], -1)
    try:
        rows = torch.as_tensor(scan, dtype=torch.float32)
    except (TypeError, ValueError, RuntimeError):
        rows = torch.zeros(0)
    is_table = rows.ndim == 2 and rows.shape[1] >= 2 and bool(rows.isfinite().all())
    actual = type(points).__name__ if rows.ndim != 2 else tuple(rows.shape)
    hint = "give rows of x and y [m], such as HeightScan.isaac_lab().pattern"
    require(is_table, "points", "must be (P, 2) finite numbers, or more for each point", actual, hint)
    return rows


def _place_points(cfg: AttentionConfig, num_points: int) -> Tensor:
    """Return the features (F, R, S) of a scan's points."""
    require(cfg.points is not None, "points", "must be given for a scan", None, "use 'isaac_lab', or its pattern")
    rows = describe_points(cfg.points)
    _check_count(rows, num_points)
    hint = f"give grid, or kernel_size=1 and patch=1 for {num_points} points in any order"
    is_pointwise = cfg.kernel_size == cfg.patch == 1
    require(cfg.grid is not None or is_pointwise, "grid", "must be given for a convolution", None, hint)
    grid = (1, num_points) if cfg.grid is None else tuple(cfg.grid)
    fits, rule = len(grid) == 2 and grid[0] * grid[1] == num_points, f"must be rows x columns of {num_points} points"
    require(fits, "grid", rule, grid, "use (11, 17) for Isaac Lab and mjlab, (17, 11) for legged_gym")
    placed = rows.T.unflatten(-1, grid).contiguous()
    if cfg.grid is not None:
        _check_spacing(placed[:2], grid)
    return placed


def _check_spacing(xy: Tensor, grid: Sequence[int]) -> None:
    """Refuse points (2, R, S) that do not lie on a grid of equal steps in the order row by row."""
    is_even = all(torch.allclose(steps, steps[:, :1, :1], atol=1e-4) for steps in (xy.diff(dim=1), xy.diff(dim=2)))
    rule, hint = "must number the points row by row, in equal steps", f"try {tuple(reversed(grid))}, or leave it out"
    require(is_even, "grid", rule, tuple(grid), hint)


def _place_pixels(cfg: AttentionConfig, shape: Sequence[int]) -> Tensor:
    """Return the features (F, H, W) of an image's pixels: their centres, as `MapImage` places them."""
    require(cfg.grid is None, "grid", "must be None for an image", cfg.grid, "leave it out")
    has_place = (cfg.points is None) != (cfg.resolution is None)
    actual = f"points {type(cfg.points).__name__}, resolution {cfg.resolution}"
    hint = "give the resolution and offset of the MapImage that fills the group"
    require(has_place, "resolution", "or else points must be given for an image", actual, hint)
    if cfg.resolution is None:
        rows = describe_points(cfg.points)
        _check_count(rows, shape[0] * shape[1])
        return rows.T.unflatten(-1, tuple(shape)).contiguous()
    sides = zip(cfg.offset, shape, strict=True)
    x, y = (torch.tensor(patterns.space_around(middle, count, cfg.resolution)) for middle, count in sides)
    return torch.stack(torch.meshgrid(x, y, indexing="ij"))


def _check_count(rows: Tensor, num_points: int) -> None:
    hint = "give the pattern of the scan that fills this group"
    rule = f"expected {num_points}, one for each value of the group"
    require(len(rows) == num_points, "points", rule, len(rows), hint)


def _check_validity_group(name: str, shapes: Mapping[str, Sequence[int]], num_points: int) -> None:
    hint = "add it to obs_groups, or give a channel"
    require(name in shapes, "validity", f"must be one of the groups {', '.join(shapes)}", repr(name), hint)
    count = torch.Size(shapes[name]).numel()
    hint = "give the validity of the same points"
    require(count == num_points, "validity", f"must have {num_points} values, one a point", count, hint)
