"""Keyframes: each robot's contribution to a merge, kept so that it can be moved when poses are corrected."""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

import torch
from torch import Tensor

from torchelev.errors import require
from torchelev.inputs import checks
from torchelev.site.fusion.entries import read_heights, read_offers, rise
from torchelev.site.fusion.windows import Alignment, Contribution, Windows

if TYPE_CHECKING:
    from jaxtyping import Float, Int

# Layers of a keyframe, as of its merge and in the site's frame; NaN where nothing. The rows of each group turn with a
# move by their own heights, which come first.
OWN, BOUND, CONTRIBUTED = slice(0, 4), slice(4, 5), slice(5, 8)
LAYERS = (
    "elevation",
    "variance",
    "time",
    "relief",
    "upper_bound",
    "contributed_elevation",
    "contributed_variance",
    "contributed_time",
)


class Keyframes(NamedTuple):
    """The keyframes of a site, in the order of their merges."""

    ids: Int[Tensor, "K"]  #: numbers, from 0 on
    robots: Int[Tensor, "K"]  #: numbers of the robots, in the order in which the site met them
    times: Float[Tensor, "K"]  #: [s] of the merges, on the site's clock
    T_map_base: Float[Tensor, "K 4 4"]  #: poses as the site believes them: without the offset and tilt of the merge


class Rows(NamedTuple):
    """The metadata of K keyframes, on the CPU."""

    merge: Int[Tensor, "K"]  #: number of the merge
    robot: Int[Tensor, "K"]  #: number of the robot
    previous: Int[
        Tensor, "K"
    ]  #: the robot's keyframe before, with which its earlier contribution moves; itself: the first
    corner: Int[Tensor, "K 2"]  #: number of the first cell, before any move
    size: Int[Tensor, "K 2"]  #: H, W in cells
    heights: Float[Tensor, "K 2"]  #: [m] the lowest and the highest
    time: Float[Tensor, "K"]  #: [s]
    T_first: Float[Tensor, "K 4 4"]  #: pose at the merge, to which the layers belong
    T_now: Float[Tensor, "K 4 4"]  #: the corrected one


class Recorded(NamedTuple):
    """The keyframes of one merge."""

    ids: Int[Tensor, "B"]  #: numbers
    rows: Rows  #: of each
    layers: list[Tensor]  #: (8, H, W) of each; see `LAYERS`


def no_rows() -> Rows:
    """Return the rows of no keyframe."""
    numbers, heights, pose = (
        torch.zeros(0, dtype=torch.int64),
        torch.zeros(0, 2).double(),
        torch.zeros(0, 4, 4).double(),
    )
    return Rows(numbers, numbers, numbers, numbers.view(0, 1).expand(0, 2), numbers.view(0, 1).expand(0, 2), heights,
                heights[:, 0], pose, pose)  # fmt: skip


def join(*rows: Rows) -> Rows:
    """Return rows one after another."""
    return Rows(*(torch.cat(parts) for parts in zip(*rows, strict=True)))


def record(
    windows: Windows,
    alignment: Alignment,
    T_map_base: Float[Tensor, "B 4 4"],
    rows: Rows,
    num_merges: int,
    time: float,
    resolution: float,
) -> Recorded:
    """Copy the contributions of a merge.

    Args:
        windows: B windows.
        alignment: how they lie in the site's frame.
        T_map_base: poses of the robots in the map frame.
        rows: of all keyframes before.
        num_merges: with keyframes, before.
        time: [s] of the merge.
        resolution: [m].
    """
    ids = len(rows.merge) + torch.arange(len(T_map_base))
    before = torch.full_like(ids, -1) if windows.contribution is None else windows.contribution.keyframe.cpu()
    is_met, own = before >= 0, _own_layers(windows, alignment, resolution).cpu()
    new_robots = int(rows.robot.max()) + 1 if len(rows.robot) else 0
    robot = new_robots + (~is_met).cumsum(0) - 1
    robot[is_met] = rows.robot[before[is_met]]
    contributed = None if windows.contribution is None else _contributed_layers(windows.contribution, resolution).cpu()
    contributed_corner = None if windows.contribution is None else windows.contribution.known.corner.cpu()
    cropped = [
        _crop(own[:, b], windows.known.corner[b].cpu(), None if contributed is None else contributed[:, b],
              None if contributed_corner is None else contributed_corner[b])
        for b in range(len(ids))
    ]  # fmt: skip
    layers, corner = [value for value, _ in cropped], torch.stack([low for _, low in cropped])
    size = torch.tensor([value.shape[1:] for value in layers])
    heights = torch.stack([_height_limits(value) for value in layers])
    pose = _believe(T_map_base.cpu().double(), windows, alignment, resolution)
    merge, times = torch.full_like(ids, num_merges), torch.full(ids.shape, time, dtype=torch.float64)
    previous = torch.where(is_met, before, ids)
    return Recorded(ids, Rows(merge, robot, previous, corner, size, heights, times, pose, pose), layers)


def correct(rows: Rows, ids: object, T_map_base: object) -> Rows:
    """Return the rows with other poses of some keyframes; TypeError or ValueError for bad ids or poses."""
    chosen = torch.as_tensor(ids).cpu()  # type: ignore[call-overload]
    is_list = chosen.ndim == 1 and (chosen.dtype == torch.int64 or not len(chosen))
    require(is_list, "ids", "must be 1-D int64", f"{tuple(chosen.shape)} {chosen.dtype}", "see site.keyframes.ids")
    chosen = chosen.long()
    hint = "see site.keyframes.ids"
    checks.require_indices("ids", chosen, len(rows.merge), hint, always=True)
    require(chosen.unique().numel() == len(chosen), "ids", "must not repeat", chosen.tolist(), "give each once")
    poses = checks.require_tensor("T_map_base", T_map_base).cpu()
    poses = checks.check_pose("T_map_base", poses, (len(chosen), 4, 4), poses.device, True).double()
    return rows._replace(T_now=rows.T_now.index_copy(0, chosen, poses))


def _own_layers(windows: Windows, alignment: Alignment, resolution: float) -> Float[Tensor, "5 B H W"]:
    """Return the entries and the upper bounds."""
    B, H, W = windows.is_new.shape
    layers = torch.full((5, B * H * W), torch.nan, device=windows.is_new.device)
    place = windows.is_new.flatten().nonzero()[:, 0]
    entries = read_offers(windows._replace(contribution=None, before=None), alignment, resolution).at(place, place)
    layers[OWN, place] = torch.stack([*entries.heights, entries.relief])
    place = windows.is_bounded.flatten().nonzero()[:, 0]
    above = rise(windows.known, alignment, place // (H * W), place, resolution)
    layers[BOUND, place] = (windows.upper_bound.flatten()[place] - above).float()[None]
    return layers.view(5, B, H, W)


def _contributed_layers(contributed: Contribution, resolution: float) -> Float[Tensor, "3 B H W"]:
    """Return the heights of the robots' earlier contributions."""
    B, H, W = contributed.known.is_known.shape
    layers = torch.full((3, B * H * W), torch.nan, device=contributed.known.is_known.device)
    place = contributed.known.is_known.flatten().nonzero()[:, 0]
    layers[:, place] = torch.stack(
        [*read_heights(contributed.known, contributed.alignment, place // (H * W), place, resolution)]
    )
    return layers.view(3, B, H, W)


def _crop(
    own: Tensor, corner: Tensor, contributed: Tensor | None, contributed_corner: Tensor | None
) -> tuple[Tensor, Tensor]:
    """Put a robot's layers into the smallest box that holds them; return that and its first cell.

    Earlier contributions farther than a window from what is new cannot come to lie on it.
    """
    low, high = _find_box(own[0].isfinite() | own[4].isfinite(), corner)
    if (low == high).any():
        return own.new_zeros(len(LAYERS), 0, 0), corner
    reach = torch.tensor(own.shape[1:])
    if contributed is not None and contributed_corner is not None:
        first, last = _find_box(contributed[2].isfinite(), contributed_corner)
        first, last = first.maximum(low - reach), last.minimum(high + reach)
        if (first < last).all():
            low, high = low.minimum(first), high.maximum(last)
    layers = own.new_full((len(LAYERS), *(high - low).tolist()), torch.nan)
    _paste(layers[:5], low, own, corner)
    if contributed is not None and contributed_corner is not None:
        _paste(layers[CONTRIBUTED], low, contributed, contributed_corner)
    return layers, low


def _find_box(mask: Tensor, corner: Tensor) -> tuple[Tensor, Tensor]:
    """Return the first cell of the box around a mask, and that behind its last one."""
    lines = [mask.any(1 - axis).nonzero()[:, 0] for axis in (0, 1)]
    if not len(lines[0]):
        return corner, corner
    first, last = (torch.stack([line[k] for line in lines]) for k in (0, -1))
    return corner + first, corner + last + 1


def _paste(to: Tensor, to_corner: Tensor, values: Tensor, corner: Tensor) -> None:
    """Copy what two layers on the lattice have in common, in place."""
    low = torch.maximum(to_corner, corner)
    high = torch.minimum(to_corner + torch.tensor(to.shape[1:]), corner + torch.tensor(values.shape[1:]))
    if (low < high).all():
        (i, j), (k, m) = (
            [slice(a, b) for a, b in zip((low - c).tolist(), (high - c).tolist(), strict=True)]
            for c in (to_corner, corner)
        )
        to[:, i, j] = values[:, k, m]


def _height_limits(layers: Tensor) -> Tensor:
    heights = layers[[OWN.start, BOUND.start]]
    heights = heights[heights.isfinite()].double()
    return torch.stack(heights.aminmax()) if len(heights) else torch.zeros(2, dtype=torch.float64)


def _believe(T_map_base: Tensor, windows: Windows, alignment: Alignment, resolution: float) -> Tensor:
    """Return the poses in the site's frame: without the offsets and tilts of the robots' maps."""
    offset, tilt = alignment.offset.cpu().double(), alignment.tilt.cpu().double()
    center = windows.known.corner.cpu() + torch.tensor(windows.known.elevation.shape[1:]) / 2
    from_center = T_map_base[:, :2, 3] - center.double() * resolution
    zero = torch.zeros_like(offset)
    rows = [[zero, zero, tilt[:, 0]], [zero, zero, tilt[:, 1]], [-tilt[:, 0], -tilt[:, 1], zero]]
    turn = torch.linalg.matrix_exp(torch.stack([torch.stack(row, -1) for row in rows], 1))
    pose = T_map_base.clone()
    pose[:, :3, :3] = torch.where(tilt.any(1)[:, None, None], turn @ T_map_base[:, :3, :3], T_map_base[:, :3, :3])
    pose[:, 2, 3] -= offset + (tilt * from_center).sum(1)
    return pose
