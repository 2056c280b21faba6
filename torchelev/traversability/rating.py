"""What a traversability head answers for every cell."""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

from torch import Tensor

if TYPE_CHECKING:
    from jaxtyping import Float


class Rating(NamedTuple):
    """The head's answer for every cell."""

    traversability: Float[Tensor, "B H W"]  #: 0 to 1, fraction of headings at which the robot can stand there
    confidence: Float[Tensor, "B H W"]  #: 0 to 1, probability that "traversability >= 0.5" is correct
