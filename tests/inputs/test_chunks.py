"""Environments in chunks of equal size."""

import torch

from tests.helpers import small_config
from torchelev import ElevationMap
from torchelev.inputs.chunks import make_chunks

CPU, META = torch.device("cpu"), torch.device("meta")


def ends(chunks):
    return [(chunk.start, chunk.stop) for chunk in chunks]


def test_chunks_are_of_equal_size_up_to_rounding():
    grid = small_config().grid
    assert ends(make_chunks(10, grid, CPU, 4)) == [(0, 4), (4, 8), (8, 12)]
    assert ends(make_chunks(9, grid, CPU, 4)) == [(0, 3), (3, 6), (6, 9)]
    assert ends(make_chunks(3, grid, CPU, 4)) == [(0, 3)]


def test_a_chunk_is_limited_on_a_cpu_alone():
    grid = small_config((256, 256)).grid
    assert len(make_chunks(16, grid, CPU, None)) == 2
    assert len(make_chunks(16, grid, META, None)) == 1


def test_a_map_is_updated_in_its_chunks():
    assert ends(ElevationMap(small_config(), 10, chunk=4).chunks) == [(0, 4), (4, 8), (8, 12)]
    assert len(ElevationMap(small_config(), 8, device="meta").chunks) == 1
