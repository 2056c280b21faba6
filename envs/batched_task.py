"""What all tasks share: buffers that are written in place, random numbers, and how episodes ended."""

from __future__ import annotations

from typing import Any, ClassVar

import torch
from torch import Tensor, nn


class BatchedTask(nn.Module):
    """A task of B robots whose state is tensors in buffers."""

    ending_names: ClassVar[tuple[str, ...]]  #: how an episode can end
    generator: torch.Generator
    endings: Tensor  #: (len(ending_names), B), 1 for the way in which each robot's last finished episode ended

    @property
    def ending_fractions(self) -> dict[str, Tensor]:
        """Fraction of the last finished episodes that ended in each way; zeros before the first one has finished."""
        finished = self.endings.sum().clamp(min=1.0)
        return {name: ended.sum() / finished for name, ended in zip(self.ending_names, self.endings, strict=True)}

    def _note_endings(self, outcome: Any) -> None:
        """Keep how the episodes ended that a step has finished."""
        endings = torch.stack([getattr(outcome, name) for name in self.ending_names])
        self._store("endings", torch.where(outcome.done, endings.to(self.endings.dtype), self.endings))

    def _store(self, name: str, value: Tensor, mask: Tensor | None = None) -> None:
        """Write into a buffer in place, as CONTRIBUTING.md explains under inference mode."""
        buffer = getattr(self, name)
        if mask is not None:
            value = torch.where(mask.view(-1, *[1] * (buffer.ndim - 1)), value, buffer)
        buffer.copy_(value)

    def seed(self, seed: int) -> None:
        """Seed all random number generators, so that the next `reset` begins the same episodes."""
        for index, generator in enumerate(self._generators()):
            generator.manual_seed(1000 * seed + index)  # all different, also from those of the next seeds

    def _generators(self) -> list[torch.Generator]:
        """Return the random number generators of the task and its parts."""
        generators = (getattr(module, "generator", None) for module in self.modules())
        return [generator for generator in generators if isinstance(generator, torch.Generator)]

    def get_extra_state(self) -> dict[str, Any]:
        """Return the state of the random number generator, so that a resumed training continues exactly."""
        return {"generator": self.generator.get_state()}

    def set_extra_state(self, state: dict[str, Any]) -> None:
        """Set the state of the random number generator."""
        self.generator.set_state(state["generator"].cpu())
