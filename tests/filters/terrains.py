"""Layers of given and of random ground."""

import numpy as np
import torch
from hypothesis import strategies as st

SEEDS = st.integers(0, 10_000)


def random_layer(seed, shape=(2, 7, 6), share=0.7, dtype=torch.float64):
    rng = np.random.default_rng(seed)
    values, known = rng.uniform(-0.3, 0.3, shape), rng.uniform(size=shape) < share
    return torch.from_numpy(values).to(dtype), torch.from_numpy(known)


def whole(values):
    """A layer of which all is known."""
    return values, torch.ones_like(values, dtype=torch.bool)


def terrain(function, resolution, length=2.4, shift=0.0):
    """A layer of z = function(x, y), and where its cells are: the centre of the map at `shift` cells."""
    count = round(length / resolution)
    x = (torch.arange(count, dtype=torch.float64) + 0.5 + shift - count / 2) * resolution
    x, y = torch.meshgrid(x, x, indexing="ij")
    return whole(function(x, y)[None].double()), x, y
