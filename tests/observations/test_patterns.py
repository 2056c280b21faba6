"""Patterns: their points and order, the heading, and the window that they need."""

import math

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from tests.devices import NoConstants, OneDevice
from tests.helpers import pose, small_map
from tests.observations.maps import BASE, at, flat, ground_map, near, plane
from torchelev import ElevationMap
from torchelev.observations.height_scan import HeightScan
from torchelev.observations.map_image import MapImage
from torchelev.observations.patterns import ALIGNMENTS, compute_heading, space_by_arange


def test_grids_end_as_the_originals_do():
    """Isaac Lab: all steps up to the border. mjlab: up to half a step beyond it."""
    for resolution, isaac, mjlab in ((0.04, 28, 29), (0.08, 14, 15), (0.1, 12, 12)):
        size = dict(length_x=1.1, length_y=1.1, resolution=resolution)
        assert HeightScan.isaac_lab(**size).num_points == isaac**2
        assert HeightScan.mjlab(**size).num_points == mjlab**2
    assert space_by_arange(1.1, 0.04, 1e-9)[-1] == pytest.approx(0.53)
    assert space_by_arange(1.1, 0.04, 0.02)[-1] == pytest.approx(0.57)
    other = HeightScan.mjlab(length_x=0.4, length_y=0.2, resolution=0.2).pattern
    assert np.allclose(other, [(-0.2, -0.1), (0.0, -0.1), (0.2, -0.1), (-0.2, 0.1), (0.0, 0.1), (0.2, 0.1)])


@given(st.integers(1, 300), st.sampled_from([0.02, 0.03, 0.04, 0.05, 0.07, 0.08, 0.1, 0.15, 0.25]))
def test_steps_are_those_of_arange(centimetres, resolution):
    length = centimetres / 100
    isaac = torch.arange(start=-length / 2, end=length / 2 + 1.0e-9, step=resolution)
    mjlab = torch.arange(-length / 2, length / 2 + resolution * 0.5, resolution, dtype=torch.float32)
    for beyond, theirs in ((1e-9, isaac), (resolution * 0.5, mjlab)):
        mine = space_by_arange(length, resolution, beyond)
        assert len(mine) == len(theirs) and np.allclose(mine, theirs, atol=1e-6)


def test_a_grid_counts_like_a_layer():
    pattern = HeightScan.grid(length_x=0.2, length_y=0.1, resolution=0.1, offset=(1.0, 0.5)).pattern
    assert np.allclose(pattern, [(0.9, 0.45), (0.9, 0.55), (1.0, 0.45), (1.0, 0.55), (1.1, 0.45), (1.1, 0.55)])
    assert HeightScan.grid().num_points == 187


def test_rings_are_those_of_the_paper():
    pattern = np.array(HeightScan.feet().pattern)
    radius = np.hypot(*pattern.T)
    for r, count in ((0.08, 6), (0.16, 8), (0.26, 10), (0.36, 12), (0.48, 16)):
        assert np.isclose(radius, r).sum() == count
    assert HeightScan.feet().num_points == 4 * 52 and HeightScan.feet(num_feet=2).num_points == 104
    x, y = pattern[[0, 1, 6, 8, 51]].T  # ahead, 60 degrees to the left, ahead, left, 22.5 degrees to the right
    assert np.allclose(x, [0.08, 0.04, 0.16, 0.0, 0.48 * math.cos(math.pi / 8)])
    assert np.allclose(y, [0.0, 0.08 * math.sqrt(0.75), 0.0, 0.16, -0.48 * math.sin(math.pi / 8)])


def test_any_points_keep_their_order():
    xy = [(0.3, 0.1), (-0.2, 0.4), (0.3, 0.1)]
    given_as = [xy, np.array(xy), torch.tensor(xy, dtype=torch.float64)]
    scans = [HeightScan.points(points, alignment="world") for points in given_as]
    assert scans[0] == scans[1] == scans[2] and len({*scans}) == 1
    values, _ = scans[0](ground_map(plane), pose(BASE))
    # At (0.6, -0.1) and (0.1, 0.2).
    assert at(values, 0, 1, 2) == near(0.7 - 0.04, 0.7 - 0.05, 0.7 - 0.04)


def test_alignments_by_hand():
    """Nose down by 60 degrees and looking along +y: a point 0.8 m ahead, on ground that rises along +y."""
    emap, T = ground_map(lambda x, y: y), pose(BASE, yaw=math.pi / 2, pitch=math.pi / 3)
    heights = {name: float(HeightScan.points([(0.8, 0.0)], alignment=name)(emap, T)[0]) for name in ALIGNMENTS}
    assert heights["yaw"] == pytest.approx(0.7 + 0.2 - 0.8)
    assert heights["base"] == pytest.approx(0.7 + 0.2 - 0.4)
    assert heights["world"] == pytest.approx(0.7 + 0.2)


@given(st.floats(-3.1, 3.1), st.floats(-1.4, 1.4), st.floats(-1.4, 1.4))
def test_the_heading_is_yaw_whatever_the_tilt(yaw, pitch, roll):
    expected = torch.tensor([[math.cos(yaw), math.sin(yaw)]], dtype=torch.float64)
    torch.testing.assert_close(compute_heading(pose(yaw=yaw, pitch=pitch, roll=roll)), expected)


def test_straight_up_the_y_axis_says_where_left_is():
    """x up, y to (-0.6, 0.8): ahead is (0.8, 0.6), although the x axis leans to (-0.05, 0) by rounding."""
    T = torch.eye(4)[None].clone()
    T[0, :3, 0], T[0, :3, 1], T[0, :3, 2] = torch.tensor([[0.0, 0, 1], [-0.6, 0.8, 0], [-0.8, -0.6, 0]])
    torch.testing.assert_close(compute_heading(T), torch.tensor([[0.8, 0.6]]))
    T[0, 0, 0] = -0.05
    torch.testing.assert_close(compute_heading(T), torch.tensor([[0.8, 0.6]]))


@pytest.mark.parametrize("pitch", [math.pi / 2, -math.pi / 2, math.pi / 2 - 0.05, -math.pi / 2 + 0.05])
def test_a_base_that_points_straight_up_has_a_heading(pitch):
    """The y axis, turned right, takes over: without roll it says the same."""
    T = pose(yaw=0.7, pitch=pitch).requires_grad_()
    ahead = compute_heading(T)
    torch.testing.assert_close(ahead, torch.tensor([[math.cos(0.7), math.sin(0.7)]], dtype=torch.float64))
    ahead.sum().backward()
    assert T.grad.isfinite().all()


def test_a_pattern_first_read_in_inference_mode_can_be_trained_through():
    scan, emap = HeightScan.points([(0.1, 0.2)]), ground_map(plane)
    with torch.inference_mode():
        values, valid = scan(emap, pose(BASE))
        MapImage()(emap, pose(BASE))
    assert values.is_inference() and valid.all()
    T = pose(BASE).requires_grad_()
    scan(emap, T)[0].sum().backward()
    assert T.grad[0, 2, 3] == 1 and T.grad[0, 0, 3] == pytest.approx(-0.1)


@pytest.mark.slow(1)
def test_a_pattern_is_copied_to_a_device_once():
    scan, emap = HeightScan.isaac_lab(), ElevationMap(num_envs=1, device="meta")
    T = torch.empty(1, 4, 4, device="meta")
    scan(emap, T)
    with NoConstants(), OneDevice():
        assert scan(emap, T)[0].device.type == "meta"


def test_windows_that_are_too_small_are_refused_before_anything_else():
    """187 points reach hypot(0.8, 0.5) = 0.943 m; with a cell of 0.1 m on each side that takes 2.09 m."""
    scan, T = HeightScan.isaac_lab(), pose()
    assert scan(small_map(1, (21, 21)), T)[0].shape == (1, 187)
    for cells in ((20, 21), (21, 20)):
        with pytest.raises(ValueError, match=r"pattern: must lie in the map .* takes 2.09 x 2.09 m, got a window of 2"):
            scan(small_map(1, cells), "no pose")
    world = HeightScan.isaac_lab(alignment="world")
    assert world(small_map(1, (18, 12)), T)[0].shape == (1, 187)
    with pytest.raises(ValueError, match="takes 1.8 x 1.2 m, got a window of 1.8 x 1.1 m; enlarge length_x"):
        world(small_map(1, (18, 11)), T)
    with pytest.raises(ValueError, match=r"takes 2.36 x 2.36 m"):
        HeightScan.feet(reach=0.6)(small_map(1, (23, 23)), T, torch.zeros(1, 4, 3))
    with pytest.raises(ValueError, match="pattern: must lie in the map"):
        MapImage()(small_map(1, (20, 20)), T)


@pytest.mark.slow(1)
def test_no_point_leaves_a_window_that_is_large_enough():
    """At every heading, with the base half a cell off the centre."""
    emap = ground_map(flat, corner=(-10, -11), cells=(21, 21))
    scan = HeightScan.isaac_lab(mode="bilinear")
    for yaw in np.linspace(-3.1, 3.1, 50):
        for dx, dy in ((0.049, 0.049), (-0.049, 0.049)):
            assert scan(emap, pose((0.05 + dx, -0.05 + dy, 0.5), yaw=yaw))[1].all()


@pytest.mark.parametrize("rings", [(0.1, 8), [(0.1, 8, 1)], [(8, 0.1)], [(-0.1, 8)], [(0.1, 0)]])
def test_rings_that_are_none_are_refused(rings):
    with pytest.raises(ValueError, match="rings: must be pairs of a radius and a number of points"):
        HeightScan.feet(rings=rings)
