"""Choose where each robot goes next: to the frontiers of the known ground, each robot to a different one.

Frontiers are free cells beside unknown ones (Yamauchi, "A frontier-based approach for autonomous exploration", 1997).
Robots choose them one after the other; each choice lowers what the frontiers around it are worth to the other robots
(Burgard, Moors, Stachniss and Schneider, "Coordinated Multi-Robot Exploration", IEEE T-RO 2005). Ours: the worth of a
frontier is the unknown area around it for each metre of the way.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

import numpy as np
import torch
import torch.nn.functional as F
from numpy.typing import NDArray
from torch import Tensor

from torchelev.planning.cost_to_go import cost_to_go, descend

if TYPE_CHECKING:
    from jaxtyping import Bool, Float, Int

COARSE = 0.5  # [m] side of the cells that paths lead through, about
_MAX_RISE, _RISE_RADIUS = 0.3, 0.2  # [m] a robot climbs no more than this, within this distance in x and y
_KNOWN_SHARE = 0.7  # of a coarse cell's cells, from which on it counts as known
_VIEW = 3.0  # [m] half the side of the square that a robot sees at its goal
_ARRIVED = 0.5  # [m] from a goal
_SHORTEST_WAY = 2.0  # [m] nearer goals are no better than this
_NONE = -1  # in place of a goal


class CoarseMap(NamedTuple):
    """The area in coarse cells: which are known, and where robots can walk."""

    known: Bool[Tensor, "H W"]  #: enough of the cell is known
    free: Bool[Tensor, "H W"]  #: known, and neither steep nor stepped


def cells_per_coarse_cell(resolution: float) -> int:
    """Return how many cells a coarse cell spans along x and y."""
    return max(1, round(COARSE / resolution))


def coarsen(elevation: Float[Tensor, "n n"], resolution: float) -> CoarseMap:
    """Summarise a map in coarse cells; `elevation` [m] is NaN where unknown."""
    count, radius = cells_per_coarse_cell(resolution), max(1, round(_RISE_RADIUS / resolution))
    is_known = elevation.isfinite()[None]
    highest, lowest = (
        F.max_pool2d(torch.where(is_known, sign * elevation, -torch.inf), 2 * radius + 1, 1, radius) for sign in (1, -1)
    )
    blocked = F.max_pool2d((highest + lowest > _MAX_RISE).float(), count)[0] > 0
    known = F.avg_pool2d(is_known.float(), count)[0] >= _KNOWN_SHARE
    return CoarseMap(known, known & ~blocked)


class Explorer:
    """Chooses goals and paths of B robots in a square area around the origin.

    Args:
        num_robots: B.
        size: side of the area [m].
        coarse: side of a coarse cell [m].

    Attributes:
        goals: (B,) numbers of coarse cells, row by row; -1: none.
        is_done: the last plan found nothing to explore.
    """

    def __init__(self, num_robots: int, size: float, coarse: float) -> None:
        self.num_cells, self.coarse = round(size / coarse), coarse
        self.goals, self.is_done = np.full(num_robots, _NONE), False
        self._given_up = np.zeros(self.num_cells**2, dtype=bool)  # goals that were reached without learning more

    def plan(self, area: CoarseMap, xy: NDArray) -> list[NDArray]:
        """Choose goals and return paths (K, 2) [m] to them; robots at xy (B, 2) [m] without a goal get an empty one."""
        own = self.find_cells(xy)
        cost = torch.where(area.free, 1.0, torch.inf).expand(len(xy), -1, -1).clone()
        start = F.one_hot(torch.as_tensor(own), self.num_cells**2).bool().view(cost.shape)
        cost[start] = 1.0  # ground below a robot that is seen later must not trap it
        way = cost_to_go(cost, start, resolution=self.coarse)
        self._choose_goals(area, way.flatten(1).numpy(), xy)
        self.is_done = bool((self.goals == _NONE).all())
        return self._trace(way, cost)

    def _choose_goals(self, area: CoarseMap, way: NDArray, xy: NDArray) -> None:
        gain, is_frontier = find_frontiers(area, self.coarse)
        arrived = np.hypot(*(xy - self.cell_centers(self.goals)).T) < _ARRIVED
        self._give_up(self.goals[arrived & (self.goals != _NONE)])
        is_open = is_frontier.numpy().ravel() & ~self._given_up
        frontiers = np.flatnonzero(is_open)
        worth = gain.numpy().ravel()[frontiers] / np.maximum(way[:, frontiers], _SHORTEST_WAY)
        keeps = (self.goals != _NONE) & is_open[self.goals] & np.isfinite(way[np.arange(len(xy)), self.goals])
        kept = np.where(keeps, self.goals, _NONE)
        self.goals = assign(worth, frontiers, self.cell_centers(frontiers), kept)

    def _give_up(self, cells: NDArray) -> None:
        """Drop goals, and the cells beside them, at which robots have arrived and something is still unknown."""
        given_up = self._given_up.reshape(self.num_cells, -1)
        for i, j in zip(*np.divmod(cells, self.num_cells), strict=True):
            given_up[max(0, i - 1) : i + 2, max(0, j - 1) : j + 2] = True

    def _trace(self, way: Tensor, cost: Tensor) -> list[NDArray]:
        """Return the paths from the robots to their goals."""
        goal = torch.as_tensor(np.maximum(self.goals, 0))
        cells = torch.stack([goal // self.num_cells, goal % self.num_cells], 1)
        path = descend(way, cost, cells, resolution=self.coarse, max_cells=self._count_steps(way, goal))
        numbers = (path.cells[..., 0] * self.num_cells + path.cells[..., 1]).flip(1).numpy()
        return [
            self.cell_centers(unique_in_order(row)[1:] if goal != _NONE else row[:0])
            for row, goal in zip(numbers, self.goals, strict=True)
        ]

    def _count_steps(self, way: Tensor, goal: Int[Tensor, "B"]) -> int:
        length = way.flatten(1).gather(1, goal[:, None])
        return int(length[length.isfinite()].max() / self.coarse) + 2 if bool(length.isfinite().any()) else 2

    def find_cells(self, xy: NDArray) -> NDArray:
        """Return the numbers of the coarse cells that hold xy (M, 2) [m]."""
        cell = np.floor(xy / self.coarse + self.num_cells / 2).astype(int).clip(0, self.num_cells - 1)
        return cell[:, 0] * self.num_cells + cell[:, 1]

    def cell_centers(self, cells: NDArray) -> NDArray:
        """Return the centres (M, 2) [m] of coarse cells."""
        return (np.stack(np.divmod(cells, self.num_cells), -1) + 0.5 - self.num_cells / 2) * self.coarse


def find_frontiers(area: CoarseMap, coarse: float) -> tuple[Float[Tensor, "H W"], Bool[Tensor, "H W"]]:
    """Return the unknown area [m^2] in view of each cell, and which cells are frontiers."""
    unknown = (~area.known).float()[None]
    radius = round(_VIEW / coarse)
    gain = F.avg_pool2d(unknown, 2 * radius + 1, 1, radius)[0] * (2 * radius + 1) ** 2 * coarse**2
    return gain, area.free & (F.max_pool2d(unknown, 3, 1, 1)[0] > 0)


def assign(worth: NDArray, frontiers: NDArray, centers: NDArray, kept: NDArray) -> NDArray:
    """Assign a frontier to each robot, the best pair first.

    Args:
        worth: (B, K) of each frontier to each robot; 0 where it cannot get there.
        frontiers: (K,) their cells.
        centers: (K, 2) [m] of these.
        kept: (B,) goals that robots keep; -1: none.

    Returns:
        Goals (B,), -1 where none is left.
    """
    goals, worth = kept.copy(), worth.copy()
    worth[kept != _NONE] = 0.0
    place = {cell: k for k, cell in enumerate(frontiers)}
    for goal in kept[kept != _NONE]:
        worth *= _left_over(centers, centers[place[goal]])
    for _ in range(len(goals) if worth.size else 0):
        robot, k = np.unravel_index(worth.argmax(), worth.shape)
        if worth[robot, k] <= 0:
            break
        goals[robot] = frontiers[k]
        worth[robot] = 0.0
        worth *= _left_over(centers, centers[k])
    return goals


def _left_over(centers: NDArray, goal: NDArray) -> NDArray:
    """Return the share of what is seen from each centre (K, 2) [m] that is not also seen from a goal (2,) [m]."""
    overlap = (1 - np.abs(centers - goal) / (2 * _VIEW)).clip(min=0).prod(1)
    return 1 - overlap


def unique_in_order(values: NDArray) -> NDArray:
    """Return values without repeats of the one before."""
    return values[np.append(True, values[1:] != values[:-1])]
