"""Distances between voxels in C++: the same as by tensors."""

from contextlib import nullcontext
from unittest import mock

import pytest
import torch

from torchelev.observations import VoxelCrop, voxel_kernel
from torchelev.observations.voxel_crop import OCCUPIED

SHAPES = {
    "the default crop": ((3, 32, 32, 40), 0.5),
    "a short reach": ((4, 5, 7, 3), 0.12),
    "one voxel": ((2, 1, 1, 1), 1.0),
    "a reach beyond the crop": ((2, 9, 4, 60), 100.0),
    "a long row": ((2, 1, 2, 400), 9.0),
    "a long row whose squares need 32 bits": ((2, 1, 2, 400), 11.0),
}


def random_states(shape, share, seed=0):
    generator = torch.Generator().manual_seed(seed)
    others = torch.randint(0, 2, shape, generator=generator) * 2
    return torch.where(torch.rand(shape, generator=generator) < share, OCCUPIED, others).to(torch.uint8)


def measure(crop, states, by_tensors):
    with mock.patch.object(voxel_kernel, "can_measure", return_value=False) if by_tensors else nullcontext():
        return crop._measure_distances(states)


@pytest.mark.slow(2)
@pytest.mark.parametrize("share", [0.0, 0.003, 0.2, 0.9, 1.0])
@pytest.mark.parametrize("name", SHAPES)
def test_tensors_and_cpp_agree(name, share):
    shape, max_distance = SHAPES[name]
    crop, states = VoxelCrop(values="distances", max_distance=max_distance), random_states(shape, share)
    assert voxel_kernel.can_measure(states)
    fast, tensors = (measure(crop, states, by_tensors) for by_tensors in (False, True))
    assert fast.dtype == torch.float32
    assert fast.shape == shape
    torch.testing.assert_close(fast, tensors, rtol=0, atol=1e-5)


def test_layouts_and_threads_do_not_matter():
    crop, states = VoxelCrop(values="distances"), random_states((5, 6, 8, 10), 0.1)
    turned = states.transpose(1, 3)
    torch.testing.assert_close(measure(crop, turned, False), measure(crop, states, False).transpose(1, 3))
    with mock.patch.object(torch, "get_num_threads", return_value=1):
        alone = measure(crop, states, False)
    assert torch.equal(alone, measure(crop, states, False))
