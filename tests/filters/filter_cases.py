"""What the tests of filters share: layers, loops over windows, and what must hold of every filter."""

import contextlib

import numpy as np
import pytest
import torch
from hypothesis import strategies as st
from torch._subclasses.fake_tensor import FakeTensorMode

from tests.helpers import without
from torchelev.filters import opencv

SEEDS = st.integers(0, 10_000)
SHAPES = st.tuples(st.integers(1, 2), st.integers(1, 8), st.integers(1, 7))
SHARES = st.sampled_from([0.0, 0.1, 0.5, 0.9, 1.0])  # of known cells
SMALL_MAPS = pytest.mark.parametrize("shape", [(1, 1, 1), (1, 1, 9), (1, 9, 1), (2, 3, 4)])
ALL_OR_NOTHING_KNOWN = pytest.mark.parametrize("share", [0.0, 1.0])


def random_layer(seed, shape=(2, 7, 6), share=0.7, dtype=torch.float64):
    """Heights around 0 and which are known; NaN elsewhere, which no filter may let through."""
    rng = np.random.default_rng(seed)
    known = torch.from_numpy(rng.random(shape) < share)
    values = torch.from_numpy(rng.normal(size=shape).round(1)).to(dtype)  # rounded: equal heights come up
    return torch.where(known, values, torch.nan), known


@contextlib.contextmanager
def no_opencv():
    """OpenCV is not installed."""
    opencv.is_installed.cache_clear()
    try:
        with pytest.MonkeyPatch.context() as patch:
            without(patch, "cv2")
            yield
    finally:
        opencv.is_installed.cache_clear()


def of_windows(layer, radius, function):
    """`function(heights, offsets (n, 2))` of the known cells of the window around each cell, NaN if there are none."""
    values, known = (part.numpy() for part in layer)
    B, H, W = values.shape
    out = np.full(values.shape, np.nan)
    for b, i, j in np.ndindex(B, H, W):
        around = [(u, v) for u in range(i - radius, i + radius + 1) for v in range(j - radius, j + radius + 1)]
        cells = [(u, v) for u, v in around if 0 <= u < H and 0 <= v < W and known[b, u, v]]
        if cells:
            out[b, i, j] = function(np.array([values[b, u, v] for u, v in cells]), np.array(cells) - (i, j))
    return out


def assert_layer(layer, expected, known, atol=1e-12):
    """The layer's values where known, 0 elsewhere."""
    values, got = layer
    assert torch.equal(got, torch.as_tensor(known))
    np.testing.assert_allclose(values.detach().numpy(), np.where(known, expected, 0.0), atol=atol, rtol=0)


def assert_batch_is_single(function, *layers, atol=0.0):
    """Each map of a batch comes out as it does alone."""
    values, known = function(*layers)
    for b in range(len(values)):
        alone, known_alone = function(*[(v[b : b + 1], k[b : b + 1]) for v, k in layers])
        torch.testing.assert_close(values[b : b + 1], alone, atol=atol, rtol=0)
        assert torch.equal(known[b : b + 1], known_alone)


def assert_gradients(function, *layers):
    """Finite differences agree; unknown cells get no gradient, whatever they hold."""
    values = [v.clone().requires_grad_() for v, _ in layers]
    function(*[(v, k) for v, (_, k) in zip(values, layers, strict=True)])[0].sum().backward()
    for v, (_, known) in zip(values, layers, strict=True):
        assert (v.grad[~known] == 0).all() and torch.isfinite(v.grad).all()
    # Heights apart from each other, so that no finite step changes their order.
    places = [torch.randperm(k.numel(), generator=torch.Generator().manual_seed(3)).view(k.shape) for _, k in layers]
    apart = [(place * 0.1 + 0.03 * n).double().requires_grad_() for n, place in enumerate(places)]
    masks = [k for _, k in layers]
    assert torch.autograd.gradcheck(lambda *v: function(*zip(v, masks, strict=True))[0], tuple(apart), atol=1e-6)


def assert_runs_on_small_maps(function, shape, share):
    """Windows may be larger than the map: its values are finite, and what is known stays so."""
    layer = random_layer(1, shape, share, torch.float32)
    values, known = function(layer, resolution=0.02)
    assert torch.isfinite(values).all() and torch.equal(known, layer[1])


def hill(resolution, altitude=0.0, hole=False):
    """A layer of 3.2 m x 3.2 m of smooth ground, of slopes up to 0.5, float32."""
    n = round(3.2 / resolution)
    x, y = np.meshgrid(*[(np.arange(n) + 0.5) * resolution] * 2, indexing="ij")
    z = altitude + 0.2 * x + 0.15 * np.sin(2 * x) * np.cos(1.5 * y)
    known = torch.ones(1, n, n, dtype=torch.bool)
    if hole:
        known = torch.from_numpy(~((abs(x - 1.28) < 0.48) & (abs(y - 1.92) < 0.64)))[None]
    return torch.from_numpy(z)[None].float(), known


def in_large_cells(layer, resolution):
    """The mean of a layer over cells of 8 cm; NaN where not all of such a cell is known."""
    n = round(0.08 / resolution)
    values = torch.where(layer[1], layer[0], torch.nan)
    return values.unflatten(2, (-1, n)).unflatten(1, (-1, n)).mean((2, 4))


def resolution_spread(function, **case):
    """The largest difference between what a filter gives at 2, 4 and 8 cm, away from the map's rim by 0.48 m."""
    maps = [in_large_cells(function(hill(r, **case), r), r)[:, 6:-6, 6:-6] for r in (0.02, 0.04, 0.08)]
    stacked = torch.stack(maps)
    both = torch.isfinite(stacked).all(0)
    assert both.any()
    return float((stacked.amax(0) - stacked.amin(0))[both].max())


def assert_never_waits(function, layers=1):
    """The filter runs on tensors that hold no data, so that nothing is read back from a device."""
    with FakeTensorMode():
        made = [(torch.zeros(2, 9, 8), torch.ones(2, 9, 8, dtype=torch.bool)) for _ in range(layers)]
        values, known = function(*made)
    assert values.shape == known.shape == (2, 9, 8) and known.dtype == torch.bool
