"""The ground on which robots stand now: by hand, against loops, and what is refused."""

import math

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from tests.devices import NoConstants, OneDevice
from tests.helpers import pose
from tests.planning.maps import (
    CORNER,
    RESOLUTION,
    ground_map,
    holds,
    near,
    only,
    random_map,
    random_polygons,
    rectangle,
)
from torchelev import ElevationMap
from torchelev.planning.footprint import FootprintConfig, check_footprint, unsafe_area
from torchelev.planning.path_check import check_path
from torchelev.planning.queries import height_profile, submap
from torchelev.planning.standing import mark_standing_cells, place_footprint

SEEDS = st.integers(0, 10_000)
FOOTPRINT = torch.tensor([[0.25, 0.125], [-0.25, 0.125], [-0.25, -0.125], [0.25, -0.125]]).double()


# By hand --------------------------------------------------------------------------------------------------------------


def test_unknown_cells_under_the_robot_are_assumed_to_carry_it():
    """4 x 2 cells, i from 6 to 9, j from 6 to 7; those with i < 8 are not known."""
    emap = ground_map(0.8)
    emap.validity[0, :8] = False
    emap.traversability[0, :8] = torch.nan
    assert only(check_footprint(emap, rectangle())) == near(False, 0.8, 0.5, 0.0)
    assert only(check_footprint(emap, rectangle(), standing=rectangle()[:, 0])) == near(True, 0.8, 0.0, 0.0)
    behind = rectangle(-0.25)[:, 0]  # i from 4 to 7
    assert only(check_footprint(emap, rectangle(), standing=behind)) == near(True, 0.8, 0.0, 0.0)
    assert only(check_footprint(emap, rectangle(-0.25), standing=behind)) == near(True, 0.0, 0.0, 0.0)
    half = rectangle(-0.125)[:, 0]  # i from 5 to 8
    assert only(check_footprint(emap, rectangle(-0.25), standing=half)) == near(False, 0.0, 0.25, 0.0)
    for nowhere in (rectangle() / 0, rectangle(0.5), rectangle(1e12), rectangle(0, 0, 9, 9)):
        assert only(check_footprint(emap, rectangle(), standing=nowhere[:, 0])) == near(False, 0.8, 0.5, 0.0)


def test_known_cells_under_the_robot_count_as_everywhere():
    emap = ground_map(0.8)
    emap.validity[0, :8] = False
    emap.traversability[0, 8, 6] = 0.1
    here = rectangle()[:, 0]
    assert only(check_footprint(emap, rectangle(), standing=here)) == near(False, (3 * 0.8 + 0.1) / 4, 0.0, 0.125)
    assert len(unsafe_area(emap, rectangle())[0][0]) == 4
    emap.traversability.fill_(0.4)
    assert only(check_footprint(emap, rectangle(), standing=here)) == near(False, 0.4, 0.0, 0.0)


def test_beyond_the_window_nothing_is_assumed():
    """The window ends at x = 1, in the polygon's middle."""
    emap, here = ground_map(1.0, known=False), rectangle(x=1.0)
    assert only(check_footprint(emap, here, standing=here[:, 0])) == near(False, 0.0, 0.5, 0.0)


def test_a_path_starts_where_the_robot_stands():
    """Nothing is known at x < -0.25, where the robot stands; without leaving it there, a path is not safe."""
    emap = ground_map(1.0)
    emap.validity[0, :6] = False
    ahead = torch.tensor([[[-0.5, 0.0, 0.0], [-0.25, 0, 0], [0.25, 0, 0]]]).double()
    assert check_path(emap, ahead, FOOTPRINT).safe
    assert check_path(emap, ahead, FOOTPRINT, standing=rectangle(-0.5)[:, 0]).safe
    for elsewhere in (rectangle(0.5)[:, 0], torch.full((1, 3, 2), math.nan)):
        check = check_path(emap, ahead, FOOTPRINT, standing=elsewhere)
        assert check.first_unsafe.tolist() == [0] and check.footprints.unknown[0, 0] == 1
    back = torch.cat([ahead[:, :1], ahead[:, :1] - torch.tensor([0.25, 0.0, 0.0])], 1)
    assert check_path(emap, back, FOOTPRINT).first_unsafe.tolist() == [1]
    assert check_path(emap, ahead.flip(1), FOOTPRINT).first_unsafe.tolist() == [1]


# Ground of known elevation and unknown traversability -----------------------------------------------------------------


@pytest.mark.parametrize("rating", [0.0, 1.0, math.nan])
def test_unrated_cells_are_unknown(rating):
    """Whatever they hold: a quarter of the footprint's cells."""
    unrated = torch.zeros(1, 16, 14, dtype=torch.bool)
    unrated[0, 6] = True
    emap = ground_map(0.8)
    emap.traversability[unrated] = rating
    emap.rated[unrated] = False
    assert only(check_footprint(emap, rectangle())) == near(False, 0.8, 0.25, 0.0)
    assert only(check_footprint(emap, rectangle(), FootprintConfig(max_unknown=0.25))) == near(True, 0.8, 0.25, 0.0)
    assert only(check_footprint(emap, rectangle(), standing=rectangle()[:, 0])) == near(True, 0.8, 0.0, 0.0)
    assert unsafe_area(emap, rectangle())[0][0].shape == (0, 2)
    way = torch.tensor([[[0.5, 0.0, 0.0], [0.0, 0.0, 0.0]]]).double()
    assert check_path(emap, way, FOOTPRINT).first_unsafe.tolist() == [1]
    seen = submap(emap, torch.zeros(1, 2), 2.0, 1.75, ("elevation", "traversability")).layers
    assert torch.equal(seen["traversability"].isnan(), unrated) and seen["elevation"].isfinite().all()
    ends = torch.tensor([[[-0.9, 0.0]]]), torch.tensor([[[0.9, 0.0]]])
    profile = height_profile(emap, *ends, 37, "traversability", "nearest")
    assert (profile.values[profile.valid] - 0.8).abs().max() < 1e-6 and (~profile.valid).sum() in (2, 3)
    assert height_profile(emap, *ends, 37, "elevation", "nearest").valid.all()


# Against loops --------------------------------------------------------------------------------------------------------


@pytest.mark.slow(1)
@given(SEEDS)
def test_the_cells_are_those_of_loops(seed):
    """Polygons of five corners, some across the window's border; of those without a cell's centre see below."""
    emap = random_map(seed)
    polygons = random_polygons(np.random.default_rng(seed), emap)
    for p in range(polygons.shape[1]):
        marked = mark_standing_cells(emap, polygons[:, p])
        for b in range(2):
            uv = (polygons[b, p] / RESOLUTION - CORNER[b]).tolist()
            inside = [[holds(uv, i + 0.5, j + 0.5) for j in range(14)] for i in range(16)]
            if any(map(any, inside)):
                assert marked[b].tolist() == inside


@given(SEEDS)
def test_checks_agree_with_a_map_where_the_robot_stands_on_good_ground(seed):
    """Of the mean, which ignores what is assumed, both keep to the thresholds."""
    rng = np.random.default_rng(seed)
    emap, filled = random_map(seed), random_map(seed)
    polygons = random_polygons(rng, emap)
    standing = polygons[:, 0]
    below = mark_standing_cells(emap, standing) & ~emap.validity
    filled.validity |= below
    filled.rated |= below
    filled.traversability[below] = 1.0
    cfg = FootprintConfig(min_traversability=0.0, max_unknown=0.4, max_unsafe=0.4)
    check, expected = check_footprint(emap, polygons, cfg, standing=standing), check_footprint(filled, polygons, cfg)
    assert torch.equal(check.safe, expected.safe)
    assert torch.equal(check.unknown, expected.unknown) and torch.equal(check.unsafe, expected.unsafe)


def test_batches_equal_single_maps():
    emap = random_map(3)
    polygons = random_polygons(np.random.default_rng(3), emap)
    both = check_footprint(emap, polygons, standing=polygons[:, 0])
    marked = mark_standing_cells(emap, polygons[:, 0])
    single = ground_map()
    for b in range(2):
        for name, value in emap.state._asdict().items():
            if name != "statistics":
                getattr(single, name).copy_(value[b : b + 1])
        alone = check_footprint(single, polygons[b : b + 1], standing=polygons[b : b + 1, 0])
        numbers = zip(alone[:-1], both[:-1], strict=True)  # the maps' limits differ
        assert all(torch.equal(x[0], y[b]) for x, y in numbers)
        assert torch.equal(mark_standing_cells(single, polygons[b : b + 1, 0])[0], marked[b])
    assert torch.equal(
        mark_standing_cells(single, polygons[:1, 0], emap.state._replace(corner=CORNER[:1]))[0], marked[0]
    )


def test_footprints_at_poses():
    """As x, y, yaw and as matrices; a turn by 90 degrees takes (x, y) to (-y, x)."""
    emap = ground_map()
    placed = place_footprint(emap, FOOTPRINT, torch.tensor([[[0.5, -0.25, 0.0], [1.0, 2.0, math.pi / 2]]]).double())
    torch.testing.assert_close(placed[0, 0], FOOTPRINT + torch.tensor([0.5, -0.25]).double())
    turned = torch.stack([-FOOTPRINT[:, 1], FOOTPRINT[:, 0]], -1)
    torch.testing.assert_close(placed[0, 1], turned + torch.tensor([1.0, 2.0]).double())
    matrix = pose((1.0, 2.0, 0.5), math.pi / 2, 0.1, -0.2)[None]
    torch.testing.assert_close(place_footprint(emap, FOOTPRINT, matrix)[:, 0], placed[:, 1])


# Devices, and what is refused -----------------------------------------------------------------------------------------


@pytest.mark.slow(2)
def test_nothing_waits_for_the_device():
    emap = ElevationMap(num_envs=2, device="meta")
    with OneDevice(), NoConstants():
        polygons = torch.empty(2, 3, 5, 2, device="meta")
        assert check_footprint(emap, polygons, standing=polygons[:, 0]).unsafe.shape == (2, 3)
        poses = torch.empty(2, 3, 3, device="meta")
        placed = place_footprint(emap, torch.empty(4, 2, device="meta"), poses)
        assert placed.shape == (2, 3, 4, 2) and mark_standing_cells(emap, placed[:, 0]).shape == emap.validity.shape


@pytest.mark.parametrize(
    "standing, error, text",
    [
        (rectangle(), ValueError, r"expected \(1, V, 2\) with V >= 3, got \(1, 1, 4, 2\); .*place_footprint"),
        (rectangle()[:, 0, :2], ValueError, "V >= 3"),
        (rectangle()[:, 0].repeat(2, 1, 1), ValueError, "got"),
        (rectangle()[:, 0].long(), TypeError, "must be float16"),
        ([0.0, 0.0, 0.0], TypeError, "must be a torch.Tensor"),
    ],
)
def test_bad_footprints_are_refused(standing, error, text):
    with pytest.raises(error, match=f"standing: .*{text}"):
        check_footprint(ground_map(), rectangle(), standing=standing)
