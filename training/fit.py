"""A fit of a network: steps, and checkpoints from which it resumes without a difference.

Each training adds its data and its losses, in `advance`.
"""

from __future__ import annotations

import abc
import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any, Protocol

import torch
from torch import nn
from torch.utils.tensorboard import SummaryWriter
from tqdm import tqdm

from torchelev.errors import require
from torchelev.files.output_files import atomic_file
from training.resume import CHECKPOINT, deferred_interrupt


class Schedule(Protocol):
    """The settings that a fit needs."""

    @property
    def steps(self) -> int:
        """Number of steps."""

    @property
    def learning_rate(self) -> float:
        """Rate of the first step; it decays to 0 along half a cosine."""

    @property
    def weight_decay(self) -> float:
        """Of AdamW."""


class Fit(abc.ABC):
    """Steps of AdamW on a network.

    Args:
        net: to be fitted.
        cfg: its schedule.
        settings: by which a checkpoint is recognised.
    """

    net: nn.Module
    cfg: Schedule

    def __init__(self, net: nn.Module, cfg: Schedule, settings: dict[str, Any]) -> None:
        self.net, self.cfg, self.settings, self.step = net, cfg, settings, 0
        self.optimizer = torch.optim.AdamW(net.parameters(), cfg.learning_rate, weight_decay=cfg.weight_decay)

    @abc.abstractmethod
    def advance(self) -> dict[str, float]:
        """Make one step, between `_begin_step` and `_end_step`; return the values to log."""

    def _begin_step(self) -> float:
        """Forget the gradients and set the learning rate, which is returned."""
        rate = self.cfg.learning_rate * 0.5 * (1 + math.cos(math.pi * self.step / self.cfg.steps))
        for group in self.optimizer.param_groups:
            group["lr"] = rate
        self.optimizer.zero_grad()
        return rate

    def _end_step(self) -> None:
        torch.nn.utils.clip_grad_norm_(self.net.parameters(), 1.0)
        self.optimizer.step()
        self.step += 1

    def save(self, path: Path) -> None:
        """Write everything that a resume needs."""
        state = {"net": self.net.state_dict(), "optimizer": self.optimizer.state_dict()}
        save_atomically({"settings": self.settings, "step": self.step} | state, path)

    def resume(self, path: Path) -> None:
        """Continue from a checkpoint.

        Raises:
            ValueError: the checkpoint has other settings; nothing has changed then.
        """
        found = torch.load(path, weights_only=True)
        differ = [name for name, expected in self.settings.items() if found["settings"].get(name) != expected]
        actual = ", ".join(f"{name} {found['settings'].get(name)}" for name in differ)
        hint = "resume with the settings that it began with"
        require(not differ, str(path), "must be of the same settings", actual, hint)
        self.net.load_state_dict(found["net"])
        self.optimizer.load_state_dict(found["optimizer"])
        self.step = found["step"]

    def run(self, folder: Path, every: int = 200, until: int | None = None) -> None:
        """Train up to the last step, or to `until`, with a progress bar and a TensorBoard log.

        Writes a checkpoint after `every` steps and at the end.

        Raises:
            KeyboardInterrupt: Ctrl-C was pressed; the running step is finished and saved.
        """
        steps = self.cfg.steps
        until = min(until or steps, steps)
        bar = tqdm(total=steps, initial=self.step, desc="training", unit="step")
        with bar, SummaryWriter(str(folder)) as writer, deferred_interrupt("step") as is_interrupted:
            while self.step < until:
                logged = self.advance()
                for name, value in logged.items():
                    writer.add_scalar(name, value, self.step)
                bar.set_postfix({name: f"{value:.3g}" for name, value in logged.items()}, refresh=False)
                bar.update()
                if is_interrupted() or self.step == until or self.step % every == 0:
                    self.save(folder / CHECKPOINT)
                if is_interrupted():
                    raise KeyboardInterrupt


def save_atomically(values: Mapping[str, Any], path: Path) -> None:
    """Write a file by `torch.save`; an interruption leaves an older file intact."""
    with atomic_file(path) as file:
        torch.save(values, file)
