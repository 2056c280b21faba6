"""The fit: losses and steps."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass

import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor

from torchelev.errors import require, require_positive
from torchelev.robot import RobotConfig
from torchelev.traversability.net import TraversabilityNet
from torchelev.traversability.trained_range import RESOLUTIONS, ratios
from training.fit import Fit
from training.traversability.maps.data import MappedTerrain
from training.traversability.metrics import SAFE


@dataclass(frozen=True, kw_only=True)
class FitConfig:
    """Settings of the fit."""

    steps: int = 4000
    batches_per_step: int = 4
    learning_rate: float = 3e-3  #: initial; decays to 0 along half a cosine
    weight_decay: float = 1e-4
    seed: int = 0  #: of the initial weights and the order of the batches

    def __post_init__(self) -> None:
        require_positive(steps=self.steps, batches_per_step=self.batches_per_step, learning_rate=self.learning_rate)


def losses(net: TraversabilityNet, maps: MappedTerrain) -> tuple[Tensor, Tensor]:
    """Return the losses of traversability and of confidence, in which each map has the same weight.

    Both are cross entropies. The target of traversability is the fraction of headings at which the robot can stand; the
    target of confidence is whether traversability and label lie on the same side of one half.
    """
    rating, confidence = net.logits(*maps.maps, resolution=maps.resolution, robot=maps.robot)
    agrees = ((rating.detach() >= 0) == (maps.label >= SAFE)).to(rating.dtype)
    pairs = ((rating, maps.label), (confidence, agrees))
    first, second = (F.binary_cross_entropy_with_logits(*pair, reduction="none") for pair in pairs)
    return mean_over_maps(first, maps.rated), mean_over_maps(second, maps.rated)


def mean_over_maps(values: Tensor, rated: Tensor) -> Tensor:
    """Return the mean over maps (B, H, W) of the mean over the rated cells of each; 0 if no cell is rated."""
    number = rated.sum((1, 2))
    means = (values * rated).sum((1, 2)) / number.clamp(min=1)
    return means.sum() / (number > 0).sum().clamp(min=1)


def _input_ranges(robot: RobotConfig) -> dict[str, tuple[float, float]]:
    """Return the input ranges of a net for one robot: that robot, on maps of all resolutions."""
    finest, coarsest = (ratios(robot, resolution) for resolution in RESOLUTIONS)
    return {name: (value, coarsest[name]) for name, value in finest.items()}


class Trainer(Fit):
    """Fits a net to batches, whose order depends only on the seed and the step.

    Args:
        batches: at least one.
        cfg: settings of the fit.
        robot: the robot of all batches; None: they are of several robots.

    Raises:
        ValueError: there are no batches.
    """

    net: TraversabilityNet
    cfg: FitConfig

    def __init__(self, batches: list[MappedTerrain], cfg: FitConfig, robot: RobotConfig | None = None) -> None:
        require(len(batches) > 0, "batches", "must not be empty", len(batches), "give at least one")
        torch.manual_seed(cfg.seed)
        net = TraversabilityNet(ranges=None if robot is None else _input_ranges(robot))
        self.batches = batches
        data = {"data": len(batches), "robot": None if robot is None else dataclasses.asdict(robot)}
        super().__init__(net, cfg, dataclasses.asdict(cfg) | data)

    def batch(self, number: int) -> MappedTerrain:
        """Return the batch at a position in the order; every batch comes once per epoch."""
        epoch, place = divmod(number, len(self.batches))
        return self.batches[np.random.default_rng([self.cfg.seed, epoch]).permutation(len(self.batches))[place]]

    def advance(self) -> dict[str, float]:
        """Make one step; return the values to log."""
        rate = self._begin_step()
        count = self.cfg.batches_per_step
        total = {"traversability": 0.0, "confidence": 0.0}
        for number in range(self.step * count, (self.step + 1) * count):
            parts = losses(self.net, self.batch(number))
            ((parts[0] + parts[1]) / count).backward()
            for name, part in zip(total, parts, strict=True):
                total[name] += float(part.detach()) / count
        self._end_step()
        return total | {"learning_rate": rate}
