"""Height fields against hand-worked values, and their bounds against what they must bound."""

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from torchelev.kernels.cpu_build import find_compiler
from torchelev.sim.terrains import heights_kernel
from torchelev.sim.terrains.heightfield import BLOCKS, HeightField, heights_of

# One tile of 3 x 2 samples, 0.5 m apart: x = -0.5, 0, 0.5 and y = -0.25, 0.25.
SMALL = torch.tensor([[[0.0, 1.0], [2.0, 4.0], [8.0, 16.0]]])


def random_field(seed, K=3, H=9, W=14, resolution=0.1):
    rng = np.random.default_rng(seed)
    return HeightField(torch.from_numpy(rng.uniform(-1, 1, (K, H, W))), resolution)


def bilinear(heights, resolution, x, y):
    """The surface of one tile at one place, float64."""
    H, W = heights.shape
    u = min(max(x / resolution + (H - 1) / 2, 0.0), H - 1.0)
    v = min(max(y / resolution + (W - 1) / 2, 0.0), W - 1.0)
    i, j = min(int(u), H - 2), min(int(v), W - 2)
    u, v = u - i, v - j
    near, far = heights[i, j] * (1 - v) + heights[i, j + 1] * v, heights[i + 1, j] * (1 - v) + heights[i + 1, j + 1] * v
    return near * (1 - u) + far * u


@pytest.mark.parametrize(
    "x, y, expected",
    [
        (-0.5, -0.25, 0.0),
        (0.5, 0.25, 16.0),
        (0.0, -0.25, 2.0),
        (-0.25, -0.25, 1.0),  # half way between 0 and 2
        (-0.25, 0.0, 1.75),  # the mean of 0, 1, 2 and 4
        (0.25, 0.125, 8.75),  # half way between 2 and 8, and 4 and 16, lie 5 and 10; then 3/4 of the way
        (9.0, 9.0, 16.0),  # beyond a corner
        (-7.0, 0.0, 0.5),  # beyond the rim, half way between 0 and 1
        (0.25, -3.0, 5.0),
    ],
)
def test_height_by_hand(x, y, expected):
    height = HeightField(SMALL, 0.5).height(torch.tensor([0]), torch.tensor([[[x, y]]]))
    assert height.shape == (1, 1) and height.dtype == torch.float32
    assert float(height) == pytest.approx(expected, abs=1e-6)


@given(st.integers(0, 10_000))
def test_height_is_the_bilinear_surface(seed):
    field, rng = random_field(seed), np.random.default_rng(seed)
    tile_ids, xy = torch.tensor([2, 0]), rng.uniform(-1.2, 1.2, (2, 20, 2))
    heights = field.height(tile_ids, torch.from_numpy(xy))
    for b, tile in enumerate(tile_ids.tolist()):
        for m in range(20):
            expected = bilinear(field.heights[tile].double().numpy(), 0.1, *xy[b, m])
            assert float(heights[b, m]) == pytest.approx(expected, abs=1e-5)


def test_samples_come_back_at_their_places():
    field = random_field(1)
    i, j = torch.meshgrid(torch.arange(9.0), torch.arange(14.0), indexing="ij")
    xy = torch.stack([(i - 4) * 0.1, (j - 6.5) * 0.1], -1).view(1, -1, 2).expand(3, -1, 2)
    torch.testing.assert_close(field.height(torch.arange(3), xy), field.heights.flatten(1), atol=1e-5, rtol=0)


@pytest.mark.parametrize("shape", [(9, 14), (2, 2), (70, 33)])
def test_bounds_hold_what_lies_around_the_block_ahead(shape):
    field, rng = random_field(3, 2, *shape), np.random.default_rng(3)
    bounds, K, (H, W) = field.bounds, 2, shape
    cells = np.full((K, H + 1, W + 1), -np.inf)
    padded = np.pad(field.heights.numpy(), ((0, 0), (1, 1), (1, 1)), mode="edge")
    for i, j in np.ndindex(H + 1, W + 1):
        cells[:, i, j] = padded[:, i : i + 2, j : j + 2].max((1, 2))
    for level, edge in enumerate(BLOCKS):
        for _ in range(20):
            k, at = rng.integers(K), rng.uniform(-3, (H + 4, W + 4))  # [cells], some beyond the rim
            block = np.clip(np.floor(at / edge), 0, bounds.last[:, level, 0].numpy())
            number = int(bounds.first[level] + k * bounds.size[level] + block[0] * bounds.row[level] + block[1])
            near, far = (np.clip(np.floor(at + s * edge), 0, (H, W)).astype(int) for s in (-1, 1))
            assert bounds.highest[number] >= cells[k, near[0] : far[0] + 1, near[1] : far[1] + 1].max()
    assert torch.equal(bounds.highest[-K:], field.heights.amax((1, 2)))
    assert len(bounds.highest) == int(bounds.first[-1] + K * bounds.size[-1])


def test_bounds_are_tight_enough_to_skip():
    heights = torch.zeros(1, 200, 200)
    heights[0, 100, 100] = 1.0
    bounds = HeightField(heights, 0.04).bounds
    for level, edge in enumerate(BLOCKS):
        first, size = int(bounds.first[level]), int(bounds.size[level])
        # It reaches into four cells, so into two blocks along each axis, which each have two more neighbours.
        assert 9 <= int((bounds.highest[first : first + size] > 0).sum()) <= 16, edge


def test_moves_to_a_device():
    field = random_field(0)
    moved = field.to("meta")
    assert moved.device.type == "meta" and field.device.type == "cpu" and moved.num_tiles == 3
    assert moved.height(torch.zeros(2, dtype=torch.int64, device="meta"), torch.empty(2, 5, 2, device="meta")).is_meta
    again = field.to("cpu")
    assert torch.equal(again.heights, field.heights) and again.resolution == field.resolution


def test_keeps_no_reference_to_the_heights():
    heights = SMALL.clone()
    field = HeightField(heights, 0.5)
    heights.zero_()
    assert torch.equal(field.heights, SMALL)


@pytest.mark.parametrize(
    "heights, resolution, text",
    [
        (torch.zeros(3, 4), 0.1, r"heights: must be \(K, H, W\)"),
        (torch.zeros(1, 1, 4), 0.1, r"heights: must be \(K, H, W\)"),
        (torch.zeros(0, 4, 4), 0.1, r"heights: must be \(K, H, W\)"),
        (torch.tensor([[[0.0, 1.0], [torch.nan, 0.0]]]), 0.1, "heights: must be finite"),
        (torch.zeros(1, 4, 4), 0.0, "resolution: must be positive"),
        (torch.zeros(1, 4, 4), -0.1, "resolution: must be positive"),
        (torch.zeros(1, 4, 4), torch.nan, "resolution: must be positive"),
        (torch.zeros(1, 4097, 4096, device="meta"), 0.1, "at most"),
    ],
)
def test_refuses(heights, resolution, text):
    with pytest.raises(ValueError, match=text):
        HeightField(heights, resolution)


def test_refuses_other_types_and_shapes():
    with pytest.raises(TypeError, match="heights: must be a tensor"):
        HeightField(np.zeros((1, 4, 4)), 0.1)
    with pytest.raises(ValueError, match="tile_ids, xy"):
        random_field(0).height(torch.tensor([0, 1]), torch.zeros(3, 4, 2))


@pytest.mark.parametrize(
    "surface, diagonal", [("bilinear", "rising"), ("triangles", "rising"), ("triangles", "falling")]
)
@pytest.mark.parametrize("M", [1, 8, 301])
def test_heights_are_the_same_in_cpp(surface, diagonal, M, monkeypatch):
    """Of two fields at once, also beyond the rim and where points are not finite."""
    fields = [random_field(seed).with_surface(surface, diagonal) for seed in (1, 2)]
    tile_ids = torch.tensor([2, 0, 1, 1])
    xy = 2 * torch.rand(4, M, 2, generator=torch.Generator().manual_seed(M)) - 1
    xy.view(-1)[::7] = torch.tensor([torch.nan, torch.inf, -torch.inf, 1e30, 0.0]).repeat(500)[: len(xy.view(-1)[::7])]
    got = heights_of(fields, tile_ids, xy)
    assert heights_kernel.read_heights(fields, tile_ids, xy) is not None or find_compiler() is None
    monkeypatch.setenv("TORCHELEV_NATIVE", "0")
    assert heights_kernel.read_heights(fields, tile_ids, xy) is None
    for field, heights in zip(fields, got, strict=True):
        torch.testing.assert_close(heights, field.height(tile_ids, xy), rtol=0, atol=1e-6)


def test_heights_have_gradients():
    xy = torch.tensor([[[0.1, 0.05]]], requires_grad=True)
    (gradient,) = torch.autograd.grad(HeightField(SMALL, 0.5).height(torch.tensor([0]), xy).sum(), xy)
    # At 1.2 and 0.6 cells: between 2 and 8, and 4 and 16, by 6 and 12 a cell; between 3.2 and 6.4 along y.
    assert gradient[0, 0].tolist() == pytest.approx([(6 * 0.4 + 12 * 0.6) / 0.5, (6.4 - 3.2) / 0.5], abs=1e-4)


def test_refuses_other_tiles_and_fields():
    with pytest.raises(IndexError):
        HeightField(SMALL, 0.5).height(torch.tensor([1]), torch.zeros(1, 1, 2))
    with pytest.raises(ValueError, match="fields: must be alike"):
        heights_of([random_field(0), random_field(0, H=8)], torch.tensor([0]), torch.zeros(1, 1, 2))
