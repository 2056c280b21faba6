"""Result of a step of TerrainNav, and how its episodes end."""

from __future__ import annotations

from typing import NamedTuple

from torch import Tensor

ENDINGS = ("success", "fallen", "stuck", "truncated")  # how an episode can end


class Outcome(NamedTuple):
    """Result of a step for B robots."""

    reward: Tensor  #: (B,)
    success: Tensor  #: (B,) bool, whether the goal is reached
    fallen: Tensor  #: (B,) bool, whether the robot has fallen
    stuck: Tensor  #: (B,) bool, whether the robot has been blocked for too long
    truncated: Tensor  #: (B,) bool, whether time has run out
    bumped: Tensor  #: (B,) bool, whether the robot has fallen because its body met a box

    @property
    def terminated(self) -> Tensor:
        """Whether the episode has ended by success, fall or being stuck (B,)."""
        return self.success | self.fallen | self.stuck

    @property
    def done(self) -> Tensor:
        """Whether the episode has ended, in any way (B,)."""
        return self.terminated | self.truncated
