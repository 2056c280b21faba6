"""Random robots and poses for the tests of shapes, self-filter and simulated sensors."""

import dataclasses

import numpy as np
import torch

from tests.helpers import pose
from torchelev.robot_body import Box, Capsule, RobotBody


def turned(rng):
    q = rng.normal(size=4)
    return tuple(q / np.linalg.norm(q))


def random_body(rng, capsules=3, boxes=2, **options):
    """Shapes of a few decimetres on links "a" to "d", spheres among the capsules."""
    links, legs = list("abcd"), []
    for k in range(capsules):
        start, end = rng.uniform(-0.2, 0.2, (2, 3))
        end = start if k == 0 else end
        legs.append(Capsule(link=str(rng.choice(links)), start=start, end=end, radius=rng.uniform(0.02, 0.1)))
    trunks = [
        Box(
            link=str(rng.choice(links)),
            center=rng.uniform(-0.2, 0.2, 3),
            half_lengths=rng.uniform(0.03, 0.2, 3),
            quat_wxyz=turned(rng),
        )
        for _ in range(boxes)
    ]
    return RobotBody(capsules=tuple(legs), boxes=tuple(trunks), **options)


def any_poses(rng, *shape, reach=0.4):
    """Poses (*shape, 4, 4) float64, turned at random, near the origin."""
    number = int(np.prod(shape))
    poses = [pose(rng.uniform(-reach, reach, 3), *rng.uniform(-3, 3, 3)) for _ in range(number)]
    return torch.cat(poses).view(*shape, 4, 4)


def as_reference(body, T_map_base, T_base_links):
    """A body and the poses (4, 4), (K, 4, 4) of its links as the reference takes them."""
    T = (T_map_base @ T_base_links).numpy()
    return dataclasses.asdict(body), dict(zip(body.links, T, strict=True))
