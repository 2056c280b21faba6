"""The fit: losses, steps and calibration."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from pathlib import Path

import torch
from torch import Tensor

from torchelev.completion.net import CompletionNet
from torchelev.completion.predict import predict
from torchelev.completion.refine import refine
from torchelev.errors import require_positive
from training.completion.cells import Drawn, MeasuredCells, UnknownCells, choose
from training.fit import Fit

# Share of the training's cells that are to lie within two standard deviations. Of a normal distribution 95 % would; the
# rest is for ground of other kinds, on which the network is overconfident.
COVERAGE = 0.97
_MIN_DEVIATION = 1e-3  # [m]
_LARGEST_SQUARE = 100.0  # of a weighted error


@dataclass(frozen=True, kw_only=True)
class FitConfig:
    """Settings of the fit."""

    steps: int = 15000
    unknown_per_step: int = 4096  #: cells
    measured_per_step: int = 1024  #: cells
    learning_rate: float = 4e-3  #: initial; decays to 0 along half a cosine
    weight_decay: float = 1e-4
    seed: int = 0  #: of the initial weights and the choice of cells

    def __post_init__(self) -> None:
        require_positive(steps=self.steps, learning_rate=self.learning_rate)
        require_positive(unknown_per_step=self.unknown_per_step, measured_per_step=self.measured_per_step)


def losses(error: Tensor, std: Tensor, weight: Tensor) -> tuple[Tensor, Tensor]:
    """Return the losses of the mean and of the standard deviation.

    The mean minimises the absolute error, as the ground behind an edge is high or low: the median is right more often
    than the mean is near. Twice the standard deviation is the bound that COVERAGE = 97 % of the errors e stay below: it
    minimises the quantile loss of their logarithms,

        max(0.97 u, -0.03 u),    u = log |e| - log(2 std),

    which holds 97 % wherever the network can tell cells apart, however heavy the tails. Likelihoods, beta-NLL among
    them, assume a shape of the errors and miss that share where the shape is another. No gradient of the standard
    deviation reaches the mean, so that no cell is given up by calling it uncertain.
    """
    excess = (error.detach().abs() + _MIN_DEVIATION).log() - (2 * std).log()
    return (error.abs() * weight).mean(), torch.maximum(COVERAGE * excess, (COVERAGE - 1) * excess).mean()


def draw(cells: Drawn, number: int, generator: torch.Generator) -> Drawn:
    """Draw cells, with repeats."""
    return choose(cells, torch.randint(len(cells.truth), (number,), generator=generator))


def fit_std(error: Tensor, std: Tensor) -> Tensor:
    """Return the factor on standard deviations by which COVERAGE of the errors lie within two of them."""
    return torch.quantile(error.abs() / (2 * std), COVERAGE)


class Trainer(Fit):
    """Fits a network to cells, which are drawn anew at each step.

    Args:
        unknown: unknown cells.
        measured: measured cells.
        even: unknown cells that the standard deviations are calibrated with.
        cfg: settings of the fit.
    """

    net: CompletionNet
    cfg: FitConfig

    def __init__(self, unknown: UnknownCells, measured: MeasuredCells, even: UnknownCells, cfg: FitConfig) -> None:
        torch.manual_seed(cfg.seed)
        net = CompletionNet()
        self.unknown, self.measured, self.even = unknown, measured, even
        sizes = {"unknown": len(unknown.truth), "measured": len(measured.truth)}
        super().__init__(net, cfg, dataclasses.asdict(cfg) | sizes | net.config)

    def advance(self) -> dict[str, float]:
        """Make one step; return the values to log."""
        rate = self._begin_step()
        generator = torch.Generator().manual_seed(self.cfg.seed * 1_000_003 + self.step)
        unknown = draw(self.unknown, self.cfg.unknown_per_step, generator)
        measured = draw(self.measured, self.cfg.measured_per_step, generator)
        logged: dict[str, float] = {}
        total = torch.zeros(())
        answers: list[tuple[str, UnknownCells | MeasuredCells, tuple[Tensor, Tensor]]] = [
            ("unknown", unknown, predict(self.net.weights, unknown.seen)),
            ("measured", measured, refine(self.net.weights, measured.seen, measured.context)),
        ]
        for name, cells, (mean, std) in answers:
            error = mean - cells.truth
            parts = losses(error, std, cells.weight)
            total = total + parts[0] + parts[1]
            if name == "measured":  # the root mean square must not rise either, which few large errors decide
                total = total + (error * cells.weight).square().clamp(max=_LARGEST_SQUARE).mean()
            logged |= {f"{name}_error": float(parts[0].detach()), f"{name}_quantile": float(parts[1].detach())}
        total.backward()
        self._end_step()
        return logged | {"learning_rate": rate}

    @torch.no_grad()
    def calibrate(self) -> None:
        """Scale the standard deviations such that COVERAGE of the cells lie within two of them."""
        generator = torch.Generator().manual_seed(self.cfg.seed)
        unknown, measured = draw(self.even, 2**18, generator), draw(self.measured, 2**18, generator)
        mean, std = predict(self.net.weights, unknown.seen)
        refined, refined_std = refine(self.net.weights, measured.seen, measured.context)
        factors = [fit_std(mean - unknown.truth, std), fit_std(refined - measured.truth, refined_std)]
        self.net.weights.calibration.add_(torch.stack(factors).log())

    def run(self, folder: Path, every: int = 500, until: int | None = None) -> None:
        """Train as `Fit.run` does, and calibrate."""
        super().run(folder, every, until)
        self.calibrate()
