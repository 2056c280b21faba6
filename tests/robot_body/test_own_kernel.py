"""The robot's own points in C++ against their definition by tensors."""

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from tests.helpers import random_poses
from torchelev import Box, Capsule, RobotBody
from torchelev.kernels.cpu_build import find_compiler
from torchelev.robot_body.own_kernel import find_own_points
from torchelev.stages.measure.body import on_robot

pytestmark = pytest.mark.skipif(find_compiler() is None, reason="needs a C++ compiler")
PLACE = st.tuples(*[st.floats(-0.4, 0.4)] * 3)
LINKS = st.sampled_from(["a", "b", "c"])
CAPSULES = st.lists(st.builds(Capsule, link=LINKS, start=PLACE, end=PLACE, radius=st.floats(0.01, 0.3)), max_size=3)
SPHERES = st.builds(lambda at: Capsule(link="foot", start=at, end=at, radius=0.1), PLACE)
HALVES = st.tuples(*[st.floats(0.02, 0.3)] * 3)
BOXES = st.lists(
    st.builds(Box, link=LINKS, center=PLACE, half_lengths=HALVES, quat_wxyz=st.just((0.6, 0.0, 0.8, 0.0))), max_size=2
)


@given(CAPSULES, SPHERES, BOXES, st.integers(0, 1000))
def test_the_same_points_are_found(capsules, sphere, boxes, seed):
    body = RobotBody(capsules=(*capsules, sphere), boxes=tuple(boxes))
    rng, B, S, N = np.random.default_rng(seed), 2, 2, 257
    sensors, base = random_poses(rng, B * S).view(B, S, 4, 4), random_poses(rng, B)
    links = random_poses(rng, B * len(body.links), height=(-0.5, 0.0)).view(B, -1, 4, 4)
    points = torch.tensor(rng.normal(0, 0.5, (B, S, N, 3)), dtype=torch.float32)
    x, y, z = points.unbind(-1)
    wanted = on_robot(x, y, z, x * x + y * y + z * z, sensors, base, links, body)
    found = find_own_points(points, sensors, base, links, body)
    assert (found != wanted).sum() <= 1  # roots of torch are rounded otherwise


def test_what_is_no_point_is_not_on_the_robot():
    body = RobotBody(capsules=(Capsule(link="a", start=(0, 0, 0), end=(0, 0, 1), radius=5.0),))
    points = torch.tensor([[[[torch.nan, 0, 0], [torch.inf, 0, 0], [1e30, 0, 0], [1.0, 0, 0]]]])
    T = torch.eye(4)[None]
    assert find_own_points(points, T[None], T, T[None], body).tolist() == [[[False, False, False, True]]]
