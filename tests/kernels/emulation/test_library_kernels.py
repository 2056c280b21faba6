"""The library's CUDA sources on the emulated GPU, unmodified: what the threads of warps and blocks do together."""

import ctypes
from pathlib import Path

import numpy as np
import pytest
import torch

import torchelev
from tests.kernels.emulation.launcher import emulated, needs_emulation

pytestmark = needs_emulation
NATIVE = Path(torchelev.__file__).parent / "native"


@pytest.fixture(params=["forward", "backward"])
def kernels_of(request):
    """Return a source's kernels, whose threads begin in either order."""
    launchers = []

    def load(source):
        launchers.append(emulated(NATIVE / source, [NATIVE / "gpu"]))
        launchers[-1].is_backward = request.param == "backward"
        return launchers[-1]

    return load


def structure(kind, *values):
    return (kind * len(values))(*values)


def addresses(*tensors):
    result = structure(ctypes.c_void_p, *(None if tensor is None else tensor.data_ptr() for tensor in tensors))
    result.tensors = tensors  # which must live as long
    return result


def test_the_trial_kernel_doubles_a_number(kernels_of):
    number = torch.tensor([3.0, 3.0])
    kernels_of("gpu/trial.cu").launch("double_it", 2, 100, number)
    assert number.tolist() == [6.0, 3.0]


def test_blocks_move_layers_over_themselves(kernels_of):
    layers, H, W = [torch.arange(2.0 * 70 * 80).view(2, 70, 80), torch.rand(2, 70, 80)], 70, 80
    before, shift = [layer.clone() for layer in layers], torch.tensor([[3, -5], [-1, 2]])
    struct = type(
        "Layers", (ctypes.Structure,), {"_fields_": [("c", ctypes.c_void_p * 16), ("b", ctypes.c_float * 16)]}
    )
    cells, blanks = (ctypes.c_void_p * 16)(*(x.data_ptr() for x in layers)), (ctypes.c_float * 16)(-1.0, -2.0)
    kernels_of("moving/moving.cu").launch_blocks("move_floats", 4, 0, struct(cells, blanks), shift, 2, H, W)
    for layer, old, blank in zip(layers, before, (-1.0, -2.0), strict=True):
        assert torch.equal(layer[0, :-3, 5:], old[0, 3:, :-5]) and (layer[0, -3:] == blank).all()
        assert torch.equal(layer[1, 1:, :-2], old[1, :-1, 2:]) and (layer[1, :, -2:] == blank).all()


def test_a_block_finds_the_lowest_slopes_from_each_range_on(kernels_of):
    rows, azimuths, ranges = 9, 20, 7
    index, values = torch.randint(ranges * azimuths, (2, 600)), torch.randn(2, 600)
    table = torch.empty(2, rows, azimuths)
    arguments = (
        index,
        values,
        table,
        600,
        rows,
        azimuths,
        ranges,
        ctypes.c_float(9.0),
        structure(ctypes.c_int64, *[0] * 16),
    )
    kernels_of("tables/tables.cu").launch_blocks("lowest_slopes", 2, 4 * ranges * azimuths, *arguments)
    expected = torch.full((2, rows * azimuths), 9.0).scatter_reduce(1, index, values, "amin").view(2, rows, azimuths)
    assert torch.equal(table, expected.flip(1).cummin(1).values.flip(1))


def test_a_block_fits_planes_to_a_tile_that_its_threads_share(kernels_of):
    H, W, radius = 30, 50, 2
    rows, columns = torch.meshgrid(torch.arange(H), torch.arange(W), indexing="ij")
    elevation = (1e5 + 0.25 * rows - 0.125 * columns).float()[None].contiguous()
    x, y, spans = torch.empty(1, H, W), torch.empty(1, H, W), torch.zeros(1, H, W, dtype=torch.uint8)
    settings = structure(ctypes.c_float, 1.0, 0.1, 0.1, 1.0, 1.0, 1.0, 1e-3, 1e-3)
    memory = 4 * (32 + (16 + 4) * (32 + 4) + (6 + 8) * (16 + 4) * 32)
    layers, known = addresses(x, y, spans, None, None), torch.ones(1, H, W, dtype=torch.uint8)
    arguments = elevation, known, layers, H, W, radius, 0, 0, settings
    kernels_of("surface/surface.cu").launch_blocks("rate_surface", 4, memory, *arguments)
    assert spans.all() and (x - 0.25).abs().max() < 1e-4 and (y + 0.125).abs().max() < 1e-4


def test_warps_add_up_weights_and_count_the_cells_of_other_floors(kernels_of):
    H, W, B = 70, 90, 2
    heights = torch.where(torch.rand(B, H, W) < 0.3, 5.0, -0.5)
    validity, bounded, support = (torch.ones(B, H, W, dtype=torch.uint8) for _ in range(3))
    number, sums = torch.zeros(B, dtype=torch.int64), torch.zeros(4, 5)
    around = addresses(torch.zeros(B, H), torch.zeros(B, W), torch.zeros(B))
    layers = addresses(heights, heights, torch.ones(B, H, W), validity, bounded, support, number)
    floats = np.array([100.0, 0.0, 1.0, 0.5, 1.0], np.float32)
    settings = structure(ctypes.c_int32, *floats.view(np.int32).tolist(), 0, H, 0, W)
    launcher = kernels_of("overlap/overlap.cu")
    launcher.launch_blocks("sum_below", 4, 128, around, layers, sums, H, W, ctypes.c_float(1.0), settings)
    launcher.launch_blocks("clear_other_floors", 4, 0, around, layers, sums, H, W, settings)
    is_below = heights < 0
    torch.testing.assert_close(sums[:, 0].view(2, 2).sum(1), is_below.flatten(1).sum(1).float())
    assert torch.equal(validity.bool(), is_below) and torch.equal(number, (~is_below).flatten(1).sum(1))


def test_a_block_sorts_points_by_cell(kernels_of):
    B, M, C = 2, 900, 600
    slots, used = torch.randint(C, (B, M)), torch.ones(B, M, dtype=torch.uint8)
    points, noise, origin = torch.randn(B, 3, M), torch.ones(B, M), torch.zeros(B, 1, 3)
    counts, ends = (torch.zeros(B, C, dtype=torch.int32) for _ in range(2))
    result, means = torch.zeros(B * M, 8), torch.empty(B, C)
    settings = structure(ctypes.c_float, 0.1, *[0.0] * 19)
    arguments = addresses(points, noise, None, origin, used, slots), counts, ends, result, means, M, 1, C, settings
    kernels_of("fusion/fusion.cu").launch_blocks("sort_in_block", B, 4 * (C + 512), *arguments)
    expected = torch.zeros(B, C).scatter_add(1, slots, torch.ones(B, M))
    assert torch.equal(counts, expected.int()) and torch.equal(ends.flatten(), counts.flatten().cumsum(0).int())
    heights = torch.zeros(B, C).scatter_add(1, slots, points[:, 2]) / expected.clamp(min=1)
    torch.testing.assert_close(means, torch.where(expected > 0, heights, -1e30))
