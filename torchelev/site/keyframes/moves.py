"""Keyframes on the site after their robots' poses were corrected: the cells that they reach, and their heights."""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

import torch
from torch import Tensor

if TYPE_CHECKING:
    from jaxtyping import Float, Int

_ROUNDS = 3  # to find the cell that a tilt moves to a place, as the shift depends on its height
_BORDER = 1e-6  # of a cell, less than which rounding moves borders


class Moves(NamedTuple):
    """K rigid motions, p' = R (p - before) + after, float64. About the robot, so that they stay precise far away."""

    R: Float[Tensor, "K 3 3"]  #: rotation
    before: Float[Tensor, "K 3"]  #: [m] the robot
    after: Float[Tensor, "K 3"]  #: [m]

    def at(self, ids: Tensor | int) -> Moves:
        """Return some of them."""
        return Moves(*(value[ids] for value in self))


def find_moves(T_before: Float[Tensor, "K 4 4"], T_after: Float[Tensor, "K 4 4"]) -> Moves:
    """Return the motions that take one pose to another; exactly without a rotation if there is none."""
    old, new = T_before[:, :3, :3], T_after[:, :3, :3]
    R = new @ old.mT
    is_same = (R - torch.eye(3).to(R)).abs().amax((1, 2)) < 1e-12
    is_same = is_same | (old == new).flatten(1).all(1)
    R = torch.where(is_same[:, None, None], torch.eye(3).to(R), R)
    return Moves(R, T_before[:, :3, 3], T_after[:, :3, 3])


def find_footprints(
    moves: Moves,
    corner: Int[Tensor, "K 2"],
    size: Int[Tensor, "K 2"],
    heights: Float[Tensor, "K 2"],
    resolution: float,
) -> tuple[Int[Tensor, "K 2"], Int[Tensor, "K 2"]]:
    """Return the first and the last cell, x and y, of the boxes that hold moved windows.

    Args:
        moves: K motions.
        corner: first cells of the windows.
        size: H, W in cells.
        heights: [m] the lowest and the highest.
        resolution: [m].
    """
    sides = [torch.stack([corner, corner + size], 2)[:, axis].double() * resolution for axis in (0, 1)]
    x, y, z = (value.unbind(1) for value in (*sides, heights.double()))
    points = torch.stack([torch.stack([a, b, c], 1) for a in x for b in y for c in z], 1)
    moved = (moves.R[:, None] @ (points - moves.before[:, None])[..., None])[..., 0] + moves.after[:, None]
    cells = moved[..., :2] / resolution
    return (cells.amin(1) + _BORDER).floor().long(), (cells.amax(1) - _BORDER).floor().long()


def look_up(
    layers: Float[Tensor, "C H W"],
    corner: Int[Tensor, "2"],
    move: Moves,
    cells: Int[Tensor, "N 2"],
    resolution: float,
) -> Float[Tensor, "C N"]:
    """Return the values that layers have at cells once the motion has moved them; NaN where unknown.

    Args:
        layers: heights [m], which turn with the move, and others, which do not.
        corner: the layers' first cell.
        move: a single motion.
        cells: on the lattice.
        resolution: [m].
    """
    R, flat = move.R, layers.flatten(1)
    to = (cells.double() + 0.5) * resolution - move.after[:2]
    height = layers[0].nanmean().double().nan_to_num(nan=0.0).expand(len(cells))
    for _ in range(_ROUNDS if R[:2, 2].any() else 1):
        from_robot = (to - R[:2, 2] * (height - move.before[2])[:, None]) @ torch.linalg.inv(R[:2, :2]).mT
        place = _find_cells(from_robot + move.before[:2], corner, layers.shape[1:], resolution)
        found = torch.where(place >= 0, flat.index_select(1, place.clamp(min=0)), torch.nan)
        height = torch.where(found[0].isnan(), height, found[0].double())
    moved = from_robot @ R[2, :2] + R[2, 2] * (found[0].double() - move.before[2]) + move.after[2]
    return torch.cat([moved.to(layers.dtype)[None], found[1:]])


def _find_cells(xy: Tensor, corner: Tensor, size: tuple[int, ...], resolution: float) -> Int[Tensor, "N"]:
    """Return the numbers of the cells that hold points [m], -1 outside."""
    i, j = ((xy / resolution).floor().long() - corner).unbind(1)
    H, W = size
    return torch.where((i >= 0) & (i < H) & (j >= 0) & (j < W), i * W + j, -1)
