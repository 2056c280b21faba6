"""The obstacle course that the demo's robot walks."""

from __future__ import annotations

import math

import torch
from torch import Tensor

from torchelev.sim import Box, Scene
from torchelev.sim.exact.scenes import block, steps
from torchelev.sim.waves import natural_waves

ROUTE = ((-3.4, -1.6), (2.9, -1.6), (2.9, 1.5), (-2.6, 1.5), (-2.6, -0.2), (0.2, -0.2))  # [m]
PERSON_LEAVES = 6.0  # [s]
LANDMARKS = (
    ("stairs", -2.8, -2.3), ("platform", -1.6, -3.0), ("ramp", 1.0, -4.2), ("wall", 0.0, 1.0), ("box", 1.9, 0.0),
    ("wall", 2.2, 2.9), ("bar overhead", 0.6, 2.0), ("rough ground", -3.2, 2.4), ("person,\nleaves", 4.4, 0.85),
)  # fmt: skip


def make_course() -> Scene:
    """Build the scene: stairs up, a platform, a ramp down, walls, a box, an overhead bar, a person, rough ground."""
    relief = natural_waves(7, amplitude=0.06)
    gradient, top = math.tan(math.radians(15.0)), 0.6

    def terrain(x: Tensor, y: Tensor) -> Tensor:
        # The ramp falls along +x from the platform and has embankments on both sides.
        sides = 0.5 * torch.minimum(-0.413 - y, y + 3.813)
        ramp = torch.minimum(torch.minimum(gradient * (2.4 - x), 0.5 * (x + 1.3)), sides).clamp(0.0, top)
        return ramp + relief(x, y) * torch.minimum(-(x + 0.4), y - 0.3).clamp(0.0, 1.0)

    stairs = steps(-2.013, -2.613, -0.613, count=4, rise=0.15, run=0.29)
    platform = block(-2.013 + 4 * 0.29, 0.113, -2.613, -0.613, top)
    walls = (block(1.187, 1.511, 2.313, 3.387, 0.6), block(-1.213, 1.187, 0.413, 0.647, 0.45))
    bar = Box(low=(0.507, 0.7, 1.42), high=(0.661, 2.3, 1.56))
    return Scene(
        name="course",
        terrain=terrain,
        steepness=max(0.5, relief.steepness + 0.1),  # ramp and relief do not overlap; fading adds to it
        boxes=(*stairs, platform, *walls, block(1.713, 2.087, 0.413, 0.787, 0.25), bar, *_make_person()),
    )


def _make_person() -> tuple[Box, Box]:
    """Build a person who stands beside the route until `PERSON_LEAVES`, then walks off to the left."""
    x, y, speed = 3.513, 0.6, 1.0
    low, high = (x, y, 0.0), (x + 0.4, y + 0.5, 1.7)
    offset = speed * PERSON_LEAVES  # boxes move from t = 0 on: start this far back
    standing = Box(low=low, high=high, until=PERSON_LEAVES)
    walking = Box(
        low=(x, y - offset, 0.0),
        high=(x + 0.4, y + 0.5 - offset, 1.7),
        velocity=(0.0, speed, 0.0),
        since=PERSON_LEAVES,
    )
    return standing, walking
