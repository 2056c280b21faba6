"""The slow reference itself, on cases computed by hand."""

import functools
import math

import numpy as np
import pytest

from tests import reference

EYE = np.eye(4)


def test_cell_of_and_center_of():
    assert reference.cell_of(0.05, -0.05, (-2, -1), 0.1, (4, 2)) == (2, 0)
    assert reference.cell_of(0.25, 0.0, (-2, -1), 0.1, (4, 2)) is None
    assert reference.cell_of(0.0, -0.11, (-2, -1), 0.1, (4, 2)) is None
    assert reference.center_of(2, 0, (-2, -1), 0.1) == pytest.approx((0.05, -0.05))


def test_window_corner_is_the_nearest():
    assert reference.window_corner(0.0, 0.0, 0.1, (4, 3)) == (-2, -1)  # 3 cells: the centre is that of a cell
    assert reference.window_corner(0.06, -0.06, 0.1, (4, 4)) == (-1, -3)


def test_recenter_moves_against_the_window():
    layer = np.array([[1.0, 2.0], [3.0, 4.0]])
    np.testing.assert_array_equal(reference.recenter(layer, (0, 0), (1, 0), 9.0), [[3, 4], [9, 9]])
    np.testing.assert_array_equal(reference.recenter(layer, (0, 0), (0, -1), 9.0), [[9, 1], [9, 3]])


def test_ramp():
    ramp = dict(slope=0.5, distance=1.0, offset=0.2, height=0.6)
    # At r = 1.4: min(0.4 * 0.5 + 0.2, 0.6) = 0.4. At r = 5: min(2.2, 0.6) = 0.6. At r = 0.5: 0.2.
    assert reference.above_ramp(1.4, 0, 0.41, **ramp) and not reference.above_ramp(1.4, 0, 0.39, **ramp)
    assert reference.above_ramp(3, 4, 0.61, **ramp) and not reference.above_ramp(3, 4, 0.59, **ramp)
    assert reference.above_ramp(0.3, 0.4, 0.21, **ramp) and not reference.above_ramp(0.3, 0.4, 0.19, **ramp)


def test_inside_box_turns_with_the_base():
    T = EYE.copy()
    T[:3, :3], T[:3, 3] = [[0, -1, 0], [1, 0, 0], [0, 0, 1]], [5, 0, 0]  # +x of the base is +y of the map
    box = dict(lower=(0, -0.1, -1), upper=(1, 0.1, 1))
    assert reference.inside_box(np.array([5.0, 0.9, 0]), T, **box)
    assert not reference.inside_box(np.array([5.9, 0.0, 0]), T, **box)


def test_measure_gates_in_order():
    T = EYE.copy()
    T[2, 3] = 1.0
    cloud = np.array([[1, 0, -1], [math.nan, 0, 0], [9, 0, 0], [0.01, 0, 0], [0.2, 0, -0.3], [1, 0, 2], [1e300, 0, 0]])
    measured = reference.measure(
        [cloud],
        [T],
        T,
        noise=(0.01, 0.5),
        limits=(0.1, 5.0),
        exclusion=dict(slope=0, distance=0, offset=1.0, height=1.0),
        body=dict(lower=(0, -1, -0.5), upper=(0.5, 1, 0)),
    )
    assert [m["gate"] for m in measured] == ["used", "invalid", "range", "range", "body", "overhang", "range"]
    np.testing.assert_allclose(measured[0]["point"], [1, 0, 0])
    assert measured[0]["variance"] == pytest.approx(0.01 * 2 + 0.5)


def test_depth_to_points():
    depth = np.array([[2.0, 0.0]])
    points = reference.depth_to_points(depth, 1.0, 1.0, -1.0, 0.0, "z")
    np.testing.assert_allclose(points[0], [2, 0, 2])
    assert np.isnan(points[1]).all()
    along_ray = reference.depth_to_points(depth, 1.0, 1.0, -1.0, 0.0, "ray")
    np.testing.assert_allclose(along_ray[0], [math.sqrt(2), 0, math.sqrt(2)])


def test_voxel_means():
    means = reference.voxel_means(np.array([[0.1, 0, 0], [0.3, 0, 0], [-0.1, 0, 0], [math.nan, 0, 0]]), 1.0)
    assert means.keys() == {(0, 0, 0), (-1, 0, 0)}
    np.testing.assert_allclose(means[0, 0, 0], [0.2, 0, 0])


def test_age():
    variance, time = reference.age(np.array([[0.1, 0.95]]), np.array([[0.0, 2.0]]), 2.0, 0.1)
    np.testing.assert_allclose(variance, [[0.3, 1.15]])
    np.testing.assert_allclose(time, [[2, 4]])


def test_drift():
    layers = {name: np.zeros((1, 3)) for name in ("elevation", "gradient_x", "gradient_y", "variance")}
    layers |= {"validity": np.array([[True, True, False]]), "traversability": np.array([[1.0, 0.2, 1.0]])}
    layers["gradient_x"][0, 0] = 1.0
    settings = dict(min_traversability=0.5, max_variance=1.0, max_error=0.3, min_points=2, max_drift=0.2, gain=0.5)
    settings |= dict(sigma2=9.0, gate=1.0, relief=4.0)
    # Cell 0 has its centre at (0.5, 0.5): the plane is 0.25 at x = 0.75. Cell 1 is not flat, cell 2 unknown.
    points = [(0.5, 0.5, 0.1), (0.75, 0.5, 0.25 + 0.2), (0.5, 0.5, 0.31), (0.5, 1.5, 0.1), (0.5, 2.5, 0.1), (7, 7, 0.1)]
    number, mean, correction = reference.drift(layers, points, (0, 0), 1.0, **settings)
    assert number == 2 and mean == pytest.approx(0.15) and correction == pytest.approx(0.075)
    assert reference.drift(layers, points[:1], (0, 0), 1.0, **settings)[2] == 0.0
    # Around the mean of 0.1, 0.1 and 0.25 (0.15), only the first two lie within sqrt(0.06^2 + 0.08^2) = 0.1 * 0.6.
    settings |= dict(sigma2=0.06**2, gate=0.6, relief=0.08)
    points = [(0.5, 0.5, 0.1), (0.5, 0.6, 0.1), (0.5, 0.5, 0.25)]
    assert reference.drift(layers, points, (0, 0), 1.0, **settings)[:2] == (2, pytest.approx(0.1))


FUSION = dict(gate=3.0, max_gate_std=1.0, relief=0.0, scan_variance_floor=1e-9, outlier_variance=0.5, max_support=9)
FUSION |= dict(min_above=5, max_above_per_scan=2, max_variance=100.0, edges=None)
EDGES = dict(min_points=4, min_share=0.5, min_passed=0.5, refinements=2, margin=0.5, min_extreme=2, min_settled=1)


def cell(**values):
    return (
        dict(elevation=0.0, variance=1.0, known=True, support=2, challenger=0.0, challenger_support=0, time=5.0)
        | values
    )


def points(*heights, variance=1.0, beyond=False):
    return [dict(z=z, variance=variance, ray=(1.0, 0.2), beyond=beyond) for z in heights]


def test_kalman():
    assert reference.kalman(0.0, 1.0, [(1.0, 1.0)]) == (0.5, 0.5)
    assert reference.kalman(0.0, 1.0, [(1.0, 1.0), (2.0, 0.5)]) == (1.25, 0.25)


def test_fuse_cell_founds_an_unknown_cell():
    after, used, _ = reference.fuse_cell(cell(known=False, variance=7.0), points(1.0, 3.0), 0.1, **FUSION)
    assert (after["elevation"], after["variance"], after["support"]) == (2.0, 0.5, 2)
    assert after["known"] and after["time"] == 0 and used == 2


def test_fuse_cell_takes_what_agrees():
    after, used, _ = reference.fuse_cell(cell(), points(1.0, 1.0, 9.0), 0.1, **FUSION)
    # 9 is outside 3 * sqrt(2). z_s = 1, R = 1/2: h = (0 / 1 + 1 / 0.5) / 3; support 2 + 2 for - 1 against.
    assert after["elevation"] == pytest.approx(2 / 3) and after["variance"] == pytest.approx(1 / 3)
    assert after["support"] == 3 and used == 2


def test_fuse_cell_outvotes_or_founds_anew():
    after, used, _ = reference.fuse_cell(cell(), points(9.0, 9.0), 0.1, **FUSION)
    assert (after["elevation"], after["variance"], after["support"], used) == (0.0, 2.0, 0, 0)
    after, used, _ = reference.fuse_cell(cell(), points(9.0, 9.0, 9.0), 0.1, **FUSION)
    assert after["elevation"] == pytest.approx(9) and after["variance"] == pytest.approx(1 / 3)
    assert (after["support"], used) == (1, 3)


def test_fuse_cell_keeps_one_side_of_a_step():
    low_high = points(0.0, 0.0, 10.0, 10.0, variance=0.01)
    unknown, settings = cell(known=False), FUSION | dict(edges=EDGES, relief=1.0)
    after, used, ignored = reference.fuse_cell(unknown, low_high, 0.1, **settings)
    assert (after["elevation"], used, ignored) == (pytest.approx(10.0), 2, 2)
    for p in low_high[:2]:
        p["beyond"] = True
    # The scan shows the top halfway between the mean of 5 and the top of 10, the map a cell's edge below the top, but
    # only within 50 degrees of the rays, which go by 11 degrees to the left.
    behind, beside = [(1, 0), (1, 1), (1, -1)], [(0, 1), (0, -1), (-1, 1), (-1, 0)]
    cases = [((7.4, {}), 10.0), ((7.6, {}), 0.0)]
    cases += [((-9, {place: 9.8}), 10.0) for place in behind] + [((-9, {place: 9.95}), 10.0) for place in beside]
    cases += [((-9, {place: 9.95}), 0.0) for place in behind[:2]] + [((-9, {behind[2]: 9.95}), 10.0)]
    for shown, height in cases:
        after, used, ignored = reference.fuse_cell(unknown, low_high, 0.1, **settings, shown=shown)
        assert (after["elevation"], used, ignored) == (pytest.approx(height), 2, 2)


@pytest.mark.parametrize("settled, support", [(5, 5), (6, 1)])
def test_a_settled_top_stands_though_a_scan_sees_less_of_the_face(settled, support):
    """Of 4 points, two on the face of a wall of 20 and two at its foot: none is against the top, or all are."""
    seen, top = points(0.0, 0.0, 10.0, 10.0, variance=0.01), cell(elevation=20.0, support=5)
    after, used, _ = reference.fuse_cell(top, seen, 0.1, **(FUSION | dict(edges=EDGES | dict(min_settled=settled))))
    assert (after["elevation"], after["support"], used) == (20.0, support, 0)


def test_consensus_leaves_the_outlier():
    assert reference.consensus(points(1.0, 1.0), 0.0) == 1.0
    robust = reference.consensus(points(0.0, 0.0, 0.0, 0.0, 8.0), 0.0)
    # From the mean 1.6: weights (1 + 1.6^2)^-2 = 0.0789 and (1 + 6.4^2)^-2 = 0.000568; then from 0.0144.
    assert robust == pytest.approx(8 * (1 + 7.9856**2) ** -2 / (4 * (1 + 0.0144**2) ** -2), rel=1e-2)


def test_passed_center():
    args = ((-9.0, 0.5), (0, 0), 1.0, (1, 1))
    assert reference.passed_center(0.9, 0.5, *args) and not reference.passed_center(0.1, 0.5, *args)
    assert not reference.passed_center(0.6, 0.9, *args)


def test_march():
    ray = (np.array([0.5, 0.5, 4.0]), np.array([4.5, 0.5, 0.0]))
    lowest, direction = reference.march([ray], (0, 0), 1.0, (6, 1))
    # Height 4 - (x - 0.5), a quarter of a cell a step, up to x = 3.5.
    np.testing.assert_allclose(lowest[:4, 0], [3.5 + 1 / 8, 2.5 + 1 / 8, 1.5 + 1 / 8, 1 + 1 / 8])
    assert np.isinf(lowest[4:]).all()
    np.testing.assert_allclose(direction[0, 0], [0.5**0.5, 0, -(0.5**0.5)])
    height = reference.over_centers(lowest, direction, ray[0], (0, 0), 1.0)
    np.testing.assert_allclose(height[:4, 0], [4, 3, 2, 1])


def test_believed_rays():
    layers = {n: np.zeros((4, 1)) for n in ("elevation", "variance", "support", "time")}
    layers["validity"] = np.array([[True], [True], [True], [False]])
    layers["support"][:, 0] = [0, 0, 3, 9]
    layers["elevation"][1] = 0.9
    origin, limits = np.array([-4.0, 0.5, 2.0]), dict(min_support=3, gate=2.0)  # 2 * sqrt(0 + 0.5^2) = 1 m below

    def has_credible_end(x, z):
        return reference.believed_slope(origin, np.array([x, 0.5, z]), layers, (0, 0), 1.0, **limits) is not None

    assert has_credible_end(2.5, 0.0) and has_credible_end(2.5, -0.9) and not has_credible_end(2.5, -1.1)
    assert has_credible_end(1.5, 0.0), "less than a cell's edge above its neighbour"
    assert not has_credible_end(0.5, 0.0), "its neighbour has no support either"
    assert not has_credible_end(3.4, 0.0) and not has_credible_end(9.0, 0.0), "unknown, and left the window over it"
    limits |= dict(near=2.0, clearance=0.5)  # of the ground at x = 2.5
    assert has_credible_end(11.0, -0.4) and not has_credible_end(11.0, -0.6) and not has_credible_end(4.5, -0.6)

    def height(x):
        slope = reference.believed_slope(origin, np.array([x, 0.5, -0.4]), layers, (0, 0), 1.0, **limits)
        return origin[2] + 7.5 * slope

    assert height(11.0) == pytest.approx(0.8) and height(4.5) == 0.5, "over x = 3.5"
    assert not has_credible_end(3.4, 2.0), "it does not leave the window"
    layers["validity"][3] = True
    assert has_credible_end(11.0, -1.9), "it leaves the last half cell, at x = 3.5, at 0.05"
    assert not has_credible_end(11.0, -4.1), "-1.05 there"
    layers["elevation"][3] = 1.8
    assert height(4.5) == 0.5, "below what stands at the border, by the ground near by"
    over = dict(min_time=1.0, gate=2.0)
    layers["elevation"][:] = 1.5  # ground hit of late, believed within 1 m: sampled last at x = 3, 7/9 of the way
    for z, time, above in ((0.2, 0, True), (0.0, 0, False), (0.0, 2, True)):
        layers["time"][:] = time
        hit = np.array([5.0, 0.5, z])
        assert reference.stays_above_recent(origin, hit, layers, (0, 0), 1.0, **over) == above


def test_clear_seen_through():
    names = ("elevation", "variance", "time", "gradient_x", "gradient_y", "upper_bound")
    layers = {n: np.zeros((1, 5)) for n in names}
    layers["elevation"][:] = 2.0
    layers["time"][0] = [9, 0, 9, 9, 9]
    layers["variance"][0, 2] = 4.0  # h - sigma = 0 is not above the ray
    layers["validity"] = np.array([[True, True, True, False, True]])
    layers["bounded"] = np.array([[False, False, False, True, True]])
    layers["upper_bound"][0, 3] = 0.5
    lowest, down = np.array([[1.0, 1.0, 1.0, 1.0, math.inf]]), np.tile([0.6, 0.0, -0.8], (1, 5, 1))
    rule = dict(min_time=1.0, min_incidence=0.7, gate=4.0)
    validity, bounded, bound = reference.clear_seen_through(layers, lowest, down, 0.6, **rule)
    assert validity.tolist() == [[False, True, True, False, True]]
    assert bounded.tolist() == [[True, False, False, True, False]]
    assert bound[0, 0] == 1.0 and bound[0, 3] == 0.5
    rule["min_incidence"] = 0.9
    assert reference.clear_seen_through(layers, lowest, down, 0.6, **rule)[0][0, 0], "a grazing ray, 1 m below"
    rule["gate"] = 3.0
    assert not reference.clear_seen_through(layers, lowest, down, 0.6, **rule)[0][0, 0], "0.9 m explain no 1 m"
    layers["gradient_y"][:] = 0.4
    assert reference.clear_seen_through(layers, lowest, down, 0.6, **rule)[0][0, 0], "with 0.12 m of slope they do"


def test_clear_other_floors():
    layers = dict(
        elevation=np.array([[0.0, 3.0, 3.0]]),
        upper_bound=np.array([[3.0, 0.0, 3.0]]),
        validity=np.array([[True, True, True]]),
        bounded=np.array([[True, True, True]]),
        time=np.array([[9.0, 9.0, 9.0]]),
    )
    rule = dict(radius=1.5, height=2.0, base_height=0.5, max_base_height=2.0)
    clear = functools.partial(reference.clear_other_floors, layers, corner=(0, 0), resolution=1.0, **rule)
    validity, bounded, cleared = clear((0.5, 0.5, 0.0))
    assert validity.tolist() == [[True, False, True]] and bounded.tolist() == [[False, False, True]] and cleared == 1
    layers["time"][0, 1] = 0.0  # hit now, 1 m away: 3 m are within 2 m + 1 m * 2 / 1.5
    assert clear((0.5, 0.5, 0.0))[0].all()
    layers["elevation"][0] = [0.0, -1.4, 9.0]
    layers["time"][0, 1] = 9.0
    assert clear((0.5, 0.5, 1.8))[0][0, 1], "the robot counts as 0.5 m above the ground at 0"
    layers["elevation"][0, 1] = -1.6
    assert not clear((0.5, 0.5, 1.8))[0][0, 1]
    layers["elevation"][0, 1] = 0.0
    assert clear((0.5, 0.5, 1.8))[2] == 0 and clear((0.5, 0.5, 2.1))[2] == 2, "farther than 2 m below is no ground"
    layers["time"][0, 0] = 0.0
    assert clear((0.5, 0.5, 2.1))[2] == 0, "unless it is hit now: then the robot flies"


def test_fit_plane():
    known = np.ones((3, 3), bool)
    i, j = np.indices((3, 3))
    spans, gx, gy, residual = reference.fit_plane(0.2 * i - 0.1 * j, known, 1, 1, 1, 0.1)
    assert spans and (gx, gy, residual) == pytest.approx((2.0, -1.0, 0.0))
    # One line of cells along y: the gradient along it, none across.
    assert reference.fit_plane(0.2 * i - 0.1 * j, i == 1, 1, 1, 1, 0.1) == pytest.approx((False, 0.0, -1.0, 0.0))
    # A lone peak in the middle: level; mean square of (8/9, -1/9 eight times) = 8/81.
    peak = np.where((i == 1) & (j == 1), 1.0, 0.0)
    assert reference.fit_plane(peak, known, 1, 1, 1, 0.1) == pytest.approx((True, 0.0, 0.0, 8 / 81))


def test_traversability():
    critical = dict(radius=0.1, critical_slope=math.pi / 2, critical_step=0.4, critical_roughness=10.0)
    i, j = np.indices((3, 3))
    known = np.ones((3, 3), bool)
    slope = reference.traversability(0.1 * i, known, 1, 1, 0.1, **critical)  # 45 degrees of 90; 0.1 from cell to cell
    assert slope == pytest.approx(0.5)
    peak = np.where((i == 1) & (j == 1), 0.1, 0.0)
    assert reference.traversability(peak, known, 1, 1, 0.1, **critical) == pytest.approx(1 - 0.1 / 0.4)
    # A wall is a step whatever the plane.
    assert reference.traversability(0.3 * (i > 1), known, 1, 1, 0.1, **critical) == pytest.approx(1 - 0.3 / 0.4)
    assert reference.traversability(100 * peak, known, 1, 1, 0.1, **critical) == 0.0


def test_sample():
    values, known = np.array([[1.0, 2.0], [3.0, 99.0]]), np.array([[True, True], [True, False]])
    # Weights at (0.75, 0.75): 0.5625, 0.1875, 0.1875 and 0.0625 of the unknown one.
    expected = (0.5625 * 1 + 0.1875 * 2 + 0.1875 * 3) / 0.9375
    assert reference.sample(values, known, 0.75, 0.75, (0, 0), 1.0, "bilinear") == (pytest.approx(expected), True)
    assert reference.sample(values, known, 1.3, 1.3, (0, 0), 1.0, "bilinear")[1] is False
    assert reference.sample(values, known, 1.3, 0.3, (0, 0), 1.0, "nearest") == (3.0, True)
    assert reference.sample(values, known, 1.3, 1.3, (0, 0), 1.0, "nearest") == (0.0, False)


def test_feet():
    feet = np.array([[0.0, 0, 0], [1, 0, 1], [0, 1, 2]])
    assert reference.nearest_foot(0.9, 0.1, feet) == 1
    assert reference.feet_plane(0.5, 0.5, feet) == pytest.approx(1.5)
