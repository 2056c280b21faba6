"""The sections that scale an update measure at small sizes."""

import pytest
import torch

from benchmarks.speed.run import timings
from benchmarks.speed.update import scaling

SMALL = scaling.Sizes(
    points=(6276, 43074, 44000),
    of_sensors=(6276,),
    robots=(1, 2, 3),
    cells=(50, 60, 70),
    rays=(1.2, 4.8),
    many_robots=2,
)


@pytest.mark.slow(6)
@pytest.mark.parametrize("section", ["rays", "points", "threads", "robots", "cells"])
def test_sections_measure_at_small_sizes(section):
    before = torch.get_num_threads()
    result = {section: getattr(scaling, section)(0.001, SMALL)}
    assert torch.get_num_threads() == before
    assert len(list(timings(result))) >= 2
