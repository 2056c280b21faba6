"""Profiles along lines, and submaps."""

import math

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from tests.devices import NoConstants, OneDevice, unread
from tests.helpers import random_state, small_map
from torchelev import ElevationMap
from torchelev.layers import LAYERS
from torchelev.planning.queries import height_profile, submap

SEEDS = st.integers(0, 10_000)
CORNER = torch.tensor([[-6, -5], [70, -33]])


def random_map(seed, num_envs=2, known=0.7, cells=(12, 10)):
    """Cells of 0.1 m; unknown ones hold NaN."""
    emap = small_map(num_envs, cells, dtype=torch.float64)
    state = random_state(np.random.default_rng(seed), emap.cfg.grid, num_envs, known)
    elevation = torch.where(state.validity, state.elevation, torch.nan)
    emap.load_state(state._replace(corner=CORNER[:num_envs], elevation=elevation))
    return emap


def sloped():
    """One map of 12 x 10 cells around the origin: 0.1 x + 0.2 y."""
    emap = small_map(1, dtype=torch.float64)
    x, y = emap.cell_centers().unbind(-1)
    emap.elevation.copy_(0.1 * x + 0.2 * y)
    emap.validity.fill_(True)
    return emap


def points(*xy):
    return torch.tensor([xy], dtype=torch.float64)


# Profiles -------------------------------------------------------------------------------------------------------------


def test_a_profile_by_hand():
    profile = height_profile(sloped(), points((-0.3, 0.0), (0.4, -0.2)), points((0.3, 0.4), (0.4, -0.2)), 3)
    assert profile.values[0, 0].tolist() == pytest.approx([-0.03, 0.04, 0.11])
    assert profile.distance[0, 0].tolist() == pytest.approx([0.0, math.hypot(0.3, 0.2), math.hypot(0.6, 0.4)])
    assert profile.values[0, 1].tolist() == pytest.approx([0.0] * 3) and profile.distance[0, 1].tolist() == [0.0] * 3
    assert profile.valid.all() and profile.valid.shape == (1, 2, 3)


@given(SEEDS, st.sampled_from(["bilinear", "nearest"]), st.sampled_from(sorted(LAYERS)), st.integers(2, 7))
def test_profiles_are_samples(seed, mode, layer, num_points):
    emap, rng = random_map(seed), np.random.default_rng(seed)
    center = emap.center[:, None, :2]
    start, end = (center + torch.from_numpy(rng.uniform(-0.8, 0.8, (2, 3, 2))) for _ in range(2))
    profile = height_profile(emap, start, end, num_points, layer, mode)
    for k in range(num_points):
        share = k / (num_points - 1)
        values, valid = emap.sample(start + share * (end - start), layer, mode)
        torch.testing.assert_close(profile.values[:, :, k], values)
        assert torch.equal(profile.valid[:, :, k], valid)
        torch.testing.assert_close(profile.distance[:, :, k], share * (end - start).norm(dim=-1))


def test_lines_with_nan_or_inf_are_not_valid():
    start = points((0.0, 0.0), (math.nan, 0.0), (0.0, 0.0), (math.inf, 0.0), (-math.inf, 0.0))
    end = points((0.1, 0.0), (0.1, 0.0), (0.1, math.nan), (0.1, 0.0), (math.inf, 0.0))
    profile = height_profile(sloped(), start, end, 4)
    assert profile.valid[0].tolist() == [[True] * 4] + [[False] * 4] * 4
    assert not profile.values[0, 1:].any() and not profile.distance[0, 1:].any()


def test_profiles_of_other_states_and_unknown_maps():
    emap, other = random_map(0), random_map(1)
    start, end = emap.center[:, None, :2] - 0.3, emap.center[:, None, :2] + 0.3
    read = height_profile(emap, start, end, 5, state=other.state)
    assert torch.equal(read.values, height_profile(other, start, end, 5).values) and read.valid.any()
    assert not height_profile(small_map(), points((0.0, 0.0)), points((0.1, 0.0)), 5).valid.any()
    assert height_profile(emap, start[:, :0], end[:, :0], 5).values.shape == (2, 0, 5)


def test_gradcheck_of_a_profile():
    emap = random_map(2)
    state, center = emap.state, emap.center[:, None, :2]
    # Off the lines between cell centres, where the slope jumps.
    rng = np.random.default_rng(2)
    start, end = (center + torch.from_numpy(rng.uniform(-0.5, 0.5, (2, 3, 2))) for _ in range(2))
    inputs = tuple(v.clone().requires_grad_() for v in (state.elevation.nan_to_num(), start, end))

    def read(elevation, start, end):
        profile = height_profile(emap, start, end, 4, state=state._replace(elevation=elevation))
        return profile.values, profile.distance

    assert torch.autograd.gradcheck(read, inputs, eps=1e-7, atol=1e-5, fast_mode=True)
    still = points((0.1, 0.1)).requires_grad_()
    profile = height_profile(sloped(), still, still, 2)
    assert torch.autograd.grad(profile.values.sum() + profile.distance.sum(), still)[0].isfinite().all()


@pytest.mark.parametrize(
    "changes, error, text",
    [
        (dict(start=torch.zeros(1, 2)), ValueError, r"start: expected \(1, M, 2\), got \(1, 2\)"),
        (dict(end=torch.zeros(1, 3, 3)), ValueError, r"end: expected \(1, M, 2\), got \(1, 3, 3\)"),
        (dict(end=torch.zeros(1, 3, 2)), ValueError, r"end: expected \(1, 1, 2\), got \(1, 3, 2\)"),
        (dict(start=[[0.0, 0.0]]), TypeError, "start: must be a torch.Tensor"),
        (dict(num_points=1), ValueError, "num_points: must be an int of at least 2, got 1"),
        (dict(num_points=2.0), ValueError, "num_points"),
        (dict(layer="hight"), KeyError, "there are elevation"),
        (dict(mode="cubic"), ValueError, "mode: must be"),
    ],
)
def test_bad_lines_are_refused(changes, error, text):
    arguments = dict(start=torch.zeros(1, 1, 2), end=torch.zeros(1, 1, 2), num_points=3)
    with pytest.raises(error, match=text):
        height_profile(sloped(), **(arguments | changes))


# Submaps --------------------------------------------------------------------------------------------------------------


def test_a_submap_by_hand():
    """4 x 2 cells around (0.02, 0.11): cells -2 to 1 along x, 0 to 1 along y; the window's first are -6 and -5."""
    emap = sloped()
    part = submap(emap, torch.tensor([[0.02, 0.11]]), 0.4, 0.2, ("elevation", "validity"))
    assert list(part.layers) == ["elevation", "validity"] and part.resolution == 0.1
    assert part.center[0].tolist() == pytest.approx([0.0, 0.1]) and part.center.dtype == torch.float64
    assert torch.equal(part.layers["elevation"], emap.layer("elevation")[:, 4:8, 5:7])
    assert part.layers["elevation"][0, 0, 0].item() == pytest.approx(0.1 * -0.15 + 0.2 * 0.05)
    assert part.layers["elevation"][0, 3, 0].item() == pytest.approx(0.1 * 0.15 + 0.2 * 0.05)
    odd = submap(emap, torch.tensor([[0.02, 0.11]]), 0.3, 0.1)
    assert odd.center[0].tolist() == pytest.approx([0.05, 0.15])
    assert torch.equal(odd.layers["elevation"], emap.layer("elevation")[:, 5:8, 6:7])


@pytest.mark.slow(1)
@given(SEEDS, st.integers(1, 15), st.integers(1, 13), st.sampled_from([torch.float32, torch.float64]))
def test_submaps_hold_the_maps_cells(seed, h, w, dtype):
    emap, rng = random_map(seed), np.random.default_rng(seed)
    xy = emap.center[:, :2] + torch.from_numpy(rng.uniform(-1.5, 1.5, (2, 2)))
    part = submap(emap, xy.to(dtype), h * 0.1, w * 0.1, sorted(LAYERS))
    assert ((part.center - xy).abs() <= 0.05 + 1e-5).all()
    centers = emap.cell_centers().numpy()
    for name, values in part.layers.items():
        layer = emap.layer(name).numpy()
        assert values.shape == (2, h, w) and values.dtype == torch.float64
        for b in range(2):
            cells = np.round(centers[b].reshape(-1, 2) / 0.1 - 0.5).astype(int).tolist()
            found = {(i, j): value for (i, j), value in zip(cells, layer[b].flat, strict=True)}
            for i in range(h):
                for j in range(w):
                    x = part.center[b, 0].item() + (i + 0.5 - h / 2) * 0.1
                    y = part.center[b, 1].item() + (j + 0.5 - w / 2) * 0.1
                    cell = round(x / 0.1 - 0.5), round(y / 0.1 - 0.5)
                    np.testing.assert_equal(values[b, i, j].item(), found.get(cell, math.nan))


def test_submaps_are_fresh_and_read_other_states():
    emap, other = random_map(0), random_map(1)
    xy = emap.center[:, :2]
    part = submap(emap, xy, 1.2, 1.0)
    assert torch.equal(part.layers["elevation"].isnan(), emap.layer("elevation").isnan())
    part.layers["elevation"].fill_(7.0)
    assert not (emap.elevation == 7.0).any()
    moved = other.state._replace(corner=other.corner + 2)
    read = submap(emap, xy + 0.2, 1.2, 1.0, state=moved).layers["elevation"]
    torch.testing.assert_close(read, other.layer("elevation"), rtol=0, atol=0, equal_nan=True)


def test_submaps_far_away_and_larger_than_the_map():
    emap = sloped()
    for x in (5.0, -1e9, 1e30):
        assert submap(emap, torch.tensor([[x, 0.0]], dtype=torch.float64), 0.4, 0.4).layers["elevation"].isnan().all()
    large = submap(emap, torch.zeros(1, 2), 2.0, 2.0).layers["elevation"]
    assert large.isfinite().sum() == 120 and large[:, 4:16, 5:15].isfinite().all()


def test_gradients_of_a_submap():
    emap = random_map(3)
    state, xy = emap.state, emap.center[:, :2] + 0.3
    values = state.elevation.clone().requires_grad_()
    part = submap(emap, xy, 0.5, 0.5, state=state._replace(elevation=values)).layers["elevation"]
    (gradient,) = torch.autograd.grad(part[part.isfinite()].sum(), values)
    assert gradient.sum() == part.isfinite().sum() > 0 and (gradient[~state.validity] == 0).all()


def test_queries_do_not_read_values():
    """Tensors on "meta" have no values, so that reading one raises."""
    emap = ElevationMap(num_envs=2, device="meta")
    ends = torch.empty(2, 3, 2, device="meta")
    with OneDevice(), NoConstants():
        assert height_profile(emap, ends, ends, 5).values.shape == (2, 3, 5)
        assert submap(emap, ends[:, 0], 0.4, 0.8).layers["elevation"].shape == (2, 10, 20)


def test_nothing_is_known_around_points_that_are_not_finite():
    """As on a GPU, where nothing is read."""
    for bad in (math.nan, math.inf):
        assert submap(sloped(), unread(torch.tensor([[bad, 0.0]])), 0.4, 0.4).layers["elevation"].isnan().all()


@pytest.mark.parametrize(
    "changes, error, text",
    [
        (dict(center_xy=torch.zeros(2)), ValueError, r"center_xy: expected \(1, 2\), got \(2,\)"),
        (dict(center_xy=torch.full((1, 2), math.nan)), ValueError, "center_xy: must be finite"),
        (dict(center_xy=(0.0, 0.0)), TypeError, "center_xy: must be a torch.Tensor"),
        (dict(length_x=0.44), ValueError, "length_x: must be a whole number of times 0.1 m, got 4.4 times; try 0.4"),
        (dict(length_y=-1.0), ValueError, "length_y: must be a positive number"),
        (dict(layers=("elevation", "hight")), KeyError, "there are elevation, variance"),
        (dict(layers="elevation"), ValueError, "layers: must be one or more names"),
        (dict(layers=()), ValueError, "layers: must be one or more names"),
    ],
)
def test_bad_submaps_are_refused(changes, error, text):
    arguments = dict(center_xy=torch.zeros(1, 2), length_x=0.4, length_y=0.4)
    with pytest.raises(error, match=text):
        submap(sloped(), **(arguments | changes))
