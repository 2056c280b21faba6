"""The fit: losses, steps, and checkpoints from which a training goes on as if it had never stopped."""

from __future__ import annotations

import contextlib
import dataclasses
import math
import signal
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from types import FrameType

import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor
from torch.utils.tensorboard import SummaryWriter
from tqdm import tqdm

from torchelev.errors import require, require_positive
from torchelev.robot import RobotConfig
from torchelev.traversability.net import TraversabilityNet
from torchelev.traversability.weight_file import RESOLUTIONS, ratios
from training.traversability.maps.data import MappedTerrain, save_atomically
from training.traversability.metrics import SAFE

CHECKPOINT = "checkpoint.pt"


@dataclass(frozen=True, kw_only=True)
class FitConfig:
    """How weights are fitted."""

    steps: int = 4000
    batches_per_step: int = 4
    learning_rate: float = 3e-3  # falls to nothing along half a cosine
    weight_decay: float = 1e-4
    seed: int = 0  # of the first weights and of the batches' order

    def __post_init__(self) -> None:
        require_positive(steps=self.steps, batches_per_step=self.batches_per_step, learning_rate=self.learning_rate)


def losses(net: TraversabilityNet, maps: MappedTerrain) -> tuple[Tensor, Tensor]:
    """Return the losses of traversability and of confidence, each map's rated cells counting as much as another's.

    Traversability is told the share of headings at which the robot stands, confidence whether traversability is then
    on the right side of one half; both by cross entropy.
    """
    rating, confidence = net.logits(*maps.maps, resolution=maps.resolution, robot=maps.robot)
    agrees = ((rating.detach() >= 0) == (maps.label >= SAFE)).to(rating.dtype)
    pairs = ((rating, maps.label), (confidence, agrees))
    first, second = (F.binary_cross_entropy_with_logits(*pair, reduction="none") for pair in pairs)
    return mean_over_maps(first, maps.rated), mean_over_maps(second, maps.rated)


def mean_over_maps(values: Tensor, rated: Tensor) -> Tensor:
    """Return the mean over maps (B, H, W) of the mean over each one's rated cells; 0 where no cell is rated."""
    number = rated.sum((1, 2))
    means = (values * rated).sum((1, 2)) / number.clamp(min=1)
    return means.sum() / (number > 0).sum().clamp(min=1)


def ranges_of(robot: RobotConfig) -> dict[str, tuple[float, float]]:
    """Return what a net for one robot may be used for: that robot, on maps of all resolutions."""
    finest, coarsest = (ratios(robot, resolution) for resolution in RESOLUTIONS)
    return {name: (value, coarsest[name]) for name, value in finest.items()}


class Trainer:
    """Fits a net to batches, which it takes in an order that depends on the seed and the step alone.

    Args:
        batches: at least one.
        cfg: how.
        robot: the one that all batches are of; None: any.
    """

    def __init__(self, batches: list[MappedTerrain], cfg: FitConfig, robot: RobotConfig | None = None) -> None:
        require(len(batches) > 0, "batches", "must not be empty", len(batches), "give at least one")
        torch.manual_seed(cfg.seed)
        self.net = TraversabilityNet(ranges=None if robot is None else ranges_of(robot))
        self.batches, self.cfg, self.step = batches, cfg, 0
        of = {"data": len(batches), "robot": None if robot is None else dataclasses.asdict(robot)}
        self.settings = dataclasses.asdict(cfg) | of
        self.optimizer = torch.optim.AdamW(self.net.parameters(), cfg.learning_rate, weight_decay=cfg.weight_decay)

    def _batch(self, number: int) -> MappedTerrain:
        """Return the batch that comes as that number; each once before any comes again."""
        epoch, place = divmod(number, len(self.batches))
        return self.batches[np.random.default_rng([self.cfg.seed, epoch]).permutation(len(self.batches))[place]]

    def advance(self) -> dict[str, float]:
        """Make one step; return what it is logged by."""
        rate = self.cfg.learning_rate * 0.5 * (1 + math.cos(math.pi * self.step / self.cfg.steps))
        for group in self.optimizer.param_groups:
            group["lr"] = rate
        self.optimizer.zero_grad()
        count = self.cfg.batches_per_step
        total = {"traversability": 0.0, "confidence": 0.0}
        for number in range(self.step * count, (self.step + 1) * count):
            parts = losses(self.net, self._batch(number))
            (sum(parts) / count).backward()  # type: ignore[union-attr]
            for name, part in zip(total, parts, strict=True):
                total[name] += float(part.detach()) / count
        torch.nn.utils.clip_grad_norm_(self.net.parameters(), 1.0)
        self.optimizer.step()
        self.step += 1
        return total | {"learning_rate": rate}

    def save(self, path: Path) -> None:
        """Write all that a resume needs."""
        state = {"net": self.net.state_dict(), "optimizer": self.optimizer.state_dict()}
        save_atomically({"settings": self.settings, "step": self.step} | state, path)

    def resume(self, path: Path) -> None:
        """Go on from a checkpoint. Raises ValueError, before anything changed, if it is of other settings."""
        found = torch.load(path, weights_only=True)
        differ = [name for name, here in self.settings.items() if found["settings"].get(name) != here]
        actual = ", ".join(f"{name} {found['settings'].get(name)}" for name in differ)
        require(not differ, str(path), "must be of the same settings", actual, "resume with those it was begun with")
        self.net.load_state_dict(found["net"])
        self.optimizer.load_state_dict(found["optimizer"])
        self.step = found["step"]

    def run(self, folder: Path, every: int = 200, until: int | None = None) -> None:
        """Train to the last step, or to `until`, with a progress bar and a TensorBoard log.

        Leaves a checkpoint every so many steps, at the end, and at Ctrl-C, which then raises KeyboardInterrupt.
        """
        until = min(until or self.cfg.steps, self.cfg.steps)
        bar = tqdm(total=self.cfg.steps, initial=self.step, desc="training", unit="step")
        with bar, SummaryWriter(str(folder)) as writer, _interrupts() as asked:
            while self.step < until:
                logged = self.advance()
                for name, value in logged.items():
                    writer.add_scalar(name, value, self.step)
                bar.set_postfix({name: f"{value:.3g}" for name, value in logged.items()})
                bar.update()
                if asked() or self.step == until or self.step % every == 0:
                    self.save(folder / CHECKPOINT)
                if asked():
                    raise KeyboardInterrupt


@contextlib.contextmanager
def _interrupts() -> Iterator[Callable[[], bool]]:
    """Note Ctrl-C instead of raising in the middle of a step."""
    seen: list[int] = []

    def note(number: int, frame: FrameType | None) -> None:
        seen.append(number)
        tqdm.write("Stopping after this step; --resume goes on.")

    before = signal.signal(signal.SIGINT, note)
    try:
        yield lambda: bool(seen)
    finally:
        signal.signal(signal.SIGINT, before)
