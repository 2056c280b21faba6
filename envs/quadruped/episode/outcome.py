"""Result of a step of the quadruped task, and how its episodes end."""

from __future__ import annotations

from typing import NamedTuple

from torch import Tensor

ENDINGS = ("crossed", "fallen", "timed_out")  # how an episode can end


class Outcome(NamedTuple):
    """Result of a step for B robots."""

    reward: Tensor  #: (B,)
    crossed: Tensor  #: (B,) bool, whether the robot has reached the rim of its tile
    fallen: Tensor  #: (B,) bool, whether the robot has fallen
    timed_out: Tensor  #: (B,) bool, whether time has run out

    @property
    def terminated(self) -> Tensor:
        """Whether the episode has ended by a fall (B,)."""
        return self.fallen

    @property
    def truncated(self) -> Tensor:
        """Whether the episode was cut, as the tile is crossed or time has run out (B,)."""
        return self.crossed | self.timed_out

    @property
    def done(self) -> Tensor:
        """Whether the episode has ended, in any way (B,)."""
        return self.terminated | self.truncated
