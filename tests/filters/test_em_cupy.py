"""The plugins of elevation_mapping_cupy, against their definitions cell by cell."""

import cv2
import numpy as np
import pytest
import torch

from torchelev import filters


@pytest.fixture(scope="module")
def ground():
    """A slope with holes (2, 14, 11), one of which is larger than the others; map 1 is full but for a cell."""
    generator = torch.Generator().manual_seed(0)
    values = 0.1 * torch.arange(14.0)[:, None] + 0.3 * torch.rand(2, 14, 11, generator=generator)
    known = torch.rand(2, 14, 11, generator=generator) < 0.6
    known[0, 3:9, 2:8] = False
    known[1] = True
    known[1, 5, 5] = False
    return torch.where(known, values, 0.0), known


def as_nan(layer):
    return torch.where(layer[1], layer[0], torch.nan)


def window(values, i, j, k):
    return values[max(0, i - k) : i + k + 1, max(0, j - k) : j + k + 1]


def fill(values, known, k, iterations, lowest):
    """The plugins by loops: min_filter reads filled cells anew, max_filter keeps what it filled."""
    now = np.where(known, values, np.nan)
    for _ in range(iterations):
        if np.isfinite(now).all():
            break
        before = now.copy()
        for i, j in np.ndindex(now.shape):
            seen = window(before, i, j, k)
            is_open = not known[i, j] if lowest else not np.isfinite(before[i, j])
            if is_open and np.isfinite(seen).any():
                now[i, j] = np.nanmin(seen) if lowest else np.nanmax(seen)
    return now


@pytest.mark.parametrize("k, iterations", [(1, 1), (1, 3), (2, 2), (1, 40)])
@pytest.mark.parametrize("name, lowest", [("em_cupy_min_filter", True), ("em_cupy_max_filter", False)])
def test_holes_are_filled_as_by_loops(ground, name, lowest, k, iterations):
    found = as_nan(filters.FILTERS[name](ground, dilation_size=k, iteration_n=iterations))
    for b in range(2):
        expected = fill(ground[0][b].numpy(), ground[1][b].numpy(), k, iterations, lowest)
        np.testing.assert_array_equal(found[b].numpy(), expected.astype(np.float32))


def test_low_ground_spreads_across_known_cells_until_the_map_is_full():
    values = torch.tensor([[[0.0, 5.0, 0.0, 0.0, 0.0]]])
    known = torch.tensor([[[True, True, False, False, True]]])
    layer = (torch.where(known, values, 0.0), known)
    assert as_nan(filters.em_cupy_min_filter(layer, dilation_size=2, iteration_n=9)).tolist() == [[[0, 5, 0, 0, 0]]]
    assert as_nan(filters.em_cupy_min_filter(layer, dilation_size=1, iteration_n=1)).tolist() == [[[0, 5, 5, 0, 0]]]


def test_smoothing_takes_the_mean_twice(ground):
    found = as_nan(filters.em_cupy_smooth_filter(ground))
    expected = as_nan(ground).numpy()
    for _ in range(2):
        rim = np.pad(expected, ((0, 0), (1, 1), (1, 1)), mode="symmetric")
        expected = np.lib.stride_tricks.sliding_window_view(rim, (3, 3), axis=(1, 2)).mean((-1, -2))
    np.testing.assert_allclose(found.numpy(), expected, atol=1e-6)
    assert found.isnan().any() and found.isfinite().any()


@pytest.mark.parametrize("method, code", [("telea", cv2.INPAINT_TELEA), ("ns", cv2.INPAINT_NS)])
def test_inpainting_works_in_levels(ground, method, code):
    found = as_nan(filters.em_cupy_inpainting(ground, method=method))
    for b in range(2):
        values, known = ground[0][b].numpy(), ground[1][b].numpy()
        low, high = values[known].min(), values[known].max()
        image = ((np.where(known, values, low) - low) * 255 / (high - low)).astype(np.uint8)
        expected = cv2.inpaint(image, (~known).astype(np.uint8), 1, code) * ((high - low) / 255) + low
        np.testing.assert_allclose(found[b].numpy(), expected, atol=1e-5)


@pytest.mark.parametrize("reverse", [False, True])
def test_erosion_works_in_levels(ground, reverse):
    found = filters.em_cupy_erosion(ground, kernel_size=3, iterations=2, reverse=reverse)[0]
    given = 1 - ground[0] if reverse else ground[0]
    for b in range(2):
        low, high = given[b].min().item(), given[b].max().item()
        image = ((given[b].numpy() - low) * 255 / (high - low)).astype(np.uint8)
        expected = cv2.erode(image, np.ones((5, 5), np.uint8)) * ((high - low) / 255) + low
        expected = 1 - expected if reverse else expected
        expected = np.where(ground[1][b], expected, 0.0)
        np.testing.assert_allclose(found[b].numpy(), expected, atol=1e-4)


def test_maps_without_ground_and_level_ones():
    nothing = torch.zeros(2, 5, 6), torch.zeros(2, 5, 6, dtype=torch.bool)
    for name in ("min_filter", "max_filter", "smooth_filter", "inpainting", "erosion"):
        assert not filters.FILTERS[f"em_cupy_{name}"](nothing)[1].any()
    level = torch.full((1, 5, 6), 2.5), torch.ones(1, 5, 6, dtype=torch.bool)
    for name in ("inpainting", "erosion"):
        torch.testing.assert_close(filters.FILTERS[f"em_cupy_{name}"](level)[0], level[0])


@pytest.mark.parametrize(
    "name, settings, words",
    [
        ("min_filter", {"dilation_size": 0}, "dilation_size: must be a positive int"),
        ("max_filter", {"iteration_n": 0}, "iteration_n: must be a positive int"),
        ("inpainting", {"method": "fast"}, "method: must be telea or ns, got 'fast'"),
        ("erosion", {"kernel_size": 0}, "kernel_size: must be a positive int"),
    ],
)
def test_refuses_settings(ground, name, settings, words):
    with pytest.raises(ValueError, match=words):
        filters.FILTERS[f"em_cupy_{name}"](ground, **settings)
