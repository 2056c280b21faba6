"""The sections that scale an update measure at small sizes."""

import pytest
import torch

from benchmarks.speed.run import timings
from benchmarks.speed.update import scaling
from benchmarks.speed.update.sections import SECTIONS


@pytest.mark.slow(6)
@pytest.mark.parametrize("section", ["rays", "points", "threads", "robots", "cells"])
def test_sections_measure_at_small_sizes(section, monkeypatch, eager):
    small = {
        "RAYS": [1.2, 4.8],
        "POINTS": [6276, 43074, 50000],
        "ROBOTS": [1, 2, 3],
        "CELLS": [50, 60, 70],
        "MANY_ROBOTS": 2,
    }
    for name, values in small.items():
        monkeypatch.setattr(scaling, name, values)
    monkeypatch.setattr(scaling, "SENSORS", [("none", 6276, 1, 1)])
    before = torch.get_num_threads()
    result = {section: SECTIONS[section](0.001)}
    assert torch.get_num_threads() == before
    assert len(list(timings(result))) >= 2
