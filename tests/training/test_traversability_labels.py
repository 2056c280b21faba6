"""Where robots stand: hand-worked ground, symmetries, and slow loops that follow the docstrings word by word."""

import functools
import itertools
import math

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from torchelev.robot import RobotConfig
from torchelev.sim import HeightField
from training.traversability.labels.footholds import carrying, disc, lattice_around, sole, within_reach
from training.traversability.labels.labels import stand, verdicts
from training.traversability.labels.stances import VERDICTS, gentle, ground_around, plane_through, stances

ROBOT = RobotConfig()  # 0.7 x 0.4 m, feet of 3 cm that reach 0.1 m, steps of 0.2 m, clearance 0.3 m, 0.5 rad
SMALL = RobotConfig(length=0.45, width=0.3, foot_radius=0.02, foot_reach=0.07, step_height=0.1, clearance=0.15)
RESOLUTION = 0.02
ALONG, ACROSS = 0, 4  # of 8 headings: the body along x, and along y


def tile(function, length=4.0):
    """A height field of z(x, y); an edge is a ramp of 2 cm."""
    line = (torch.arange(round(length / RESOLUTION) + 1) - length / RESOLUTION / 2) * RESOLUTION
    x, y = torch.meshgrid(line, line, indexing="ij")
    return HeightField((function(x, y) + torch.zeros_like(x))[None], RESOLUTION)


def ledge(height):
    """Ground that is higher from x = 0 on: the ramp goes to x = 0.02."""
    return tile(lambda x, y: height * (x > 0.01))


def blocks(seed, height, size=0.31):
    """Squares of random heights, whose edges lie anyhow, on gentle hills."""
    table = torch.rand(64, 64, generator=torch.Generator().manual_seed(seed)) * height

    def z(x, y):
        i, j = ((a / size + 32.37).long() for a in (x, y))
        return table[i, j] + 0.03 * torch.sin(5 * x) * torch.cos(4 * y)

    return tile(z)


def places(seed, number, half=1.3):
    return (torch.rand(1, number, 2, generator=torch.Generator().manual_seed(seed)) * 2 - 1) * half


def at(field, x, y=0.003, robot=ROBOT):
    """What stops the robot at one place, by name, for each of 8 headings."""
    found = verdicts(field, torch.tensor([0]), torch.tensor([[[x, y]]]), [robot])
    return [VERDICTS[number] for number in found.flatten()]


@pytest.mark.parametrize("robot", [ROBOT, SMALL])
def test_on_flat_ground_all_stand(robot):
    field = HeightField(torch.full((2, 2, 2), 3.0), 0.5)
    xy = torch.tensor([[[0.0, 0.0], [0.013, -0.2], [7.0, 5.0]], [[-0.31, 0.27], [0.1, 0.1], [0.0, -9.0]]])
    assert stand(field, torch.tensor([1, 0]), xy, [robot, robot]).tolist() == [[[True] * 8] * 3] * 2


@pytest.mark.parametrize("height", [0.02, 0.1, 0.15, 0.19, 0.21])
@pytest.mark.parametrize("heading", [ALONG, ACROSS])
def test_across_a_ledge_stands_who_can_step_on_it(height, heading):
    """Along, front feet stand 0.7 m ahead on the ledge; across, one side's, 0.4 m apart: atan(0.21 / 0.4) < 0.5."""
    assert at(ledge(height), 0.01)[heading] == ("stands" if height <= 0.2 else "step")


@pytest.mark.parametrize(
    "x, stands",
    [
        (-0.31, True),  # front feet: 0.04 nominally, -0.06 within reach
        (-0.22, False),  # -0.03 would be half a foot over the ramp's foot, and hind feet cannot get up
        (0.01, False),
        (0.24, False),  # hind feet: -0.01 within reach, in front of the ramp
        (0.32, True),  # 0.07, a foot and more behind the edge
    ],
)
def test_beside_a_ledge_feet_make_way_by_their_reach(x, stands):
    assert (at(ledge(0.25), x)[ALONG] == "stands") == stands


def test_a_foot_may_stand_on_either_level():
    """On the lower level three feet would be far from the ledge; the fourth takes what is nearest and fits."""
    field = tile(lambda x, y: -1.0 * ((x > 0.29) & (y > 0.14)))  # a drop under the front left foot
    ground = ground_around(field, 0, torch.zeros(1, 2), ROBOT)
    found = stances(ground, torch.tensor([[0.0, 0.003]]), torch.zeros(1), ROBOT)
    assert VERDICTS[found.verdict] == "stands"
    front_left, *others = found.feet[0].tolist()
    assert front_left[2] == pytest.approx(0, abs=0.01) and (front_left[0] < 0.29 or front_left[1] < 0.14)
    assert [foot[2] for foot in others] == [0, 0, 0]
    assert torch.tensor(others)[:, :2].tolist() == [
        pytest.approx(place, abs=0.011) for place in ([0.35, -0.2], [-0.35, -0.2], [-0.35, 0.2])
    ]


@pytest.mark.parametrize("turn", [0.0, 0.4, math.pi / 4])
def test_slopes_are_stood_on_up_to_the_limit(turn):
    def slope(gradient):
        return tile(lambda x, y: gradient * (x * math.cos(turn) + y * math.sin(turn)))

    limit = math.tan(ROBOT.max_slope)
    assert at(slope(0.98 * limit), 0.1) == ["stands"] * 8
    assert at(slope(1.02 * limit), 0.1) == ["foothold"] * 8


@pytest.mark.parametrize("riser, expected", [(0.06, "stands"), (0.12, "slope")])
def test_stairs_are_as_steep_as_they_are_though_each_tread_is_level(riser, expected):
    """Treads 0.16 m deep: gradients 0.375 and 0.75, the limit is 0.546."""
    assert at(tile(lambda x, y: riser * torch.floor(x / 0.16 + 0.001)), 0.01)[ALONG] == expected


def test_a_body_is_as_steep_as_the_plane_through_its_feet():
    """0.7 tan(0.5) = 0.3824; a twist, 0.3 up on the diagonal, is level."""
    xy = [[0.35, 0.2], [0.35, -0.2], [-0.35, -0.2], [-0.35, 0.2]]
    heights = [[0.382, 0.382, 0, 0], [0.383, 0.383, 0, 0], [0.3, 0, 0.3, 0], [0.0, 0.0, 0.22, -0.22]]
    feet = torch.tensor([[[*p, z] for p, z in zip(xy, row, strict=True)] for row in heights])
    plane = plane_through(feet)
    assert plane.gradient.t().flatten().tolist() == pytest.approx([0.382 / 0.7, 0, 0.383 / 0.7, 0, 0, 0, 0, -0.55])
    assert gentle(plane, ROBOT).tolist() == [True, False, True, False]


def moat(width):
    return tile(lambda x, y: -1.0 * (x.abs() < width / 2 - 0.01))


@pytest.mark.parametrize("width, stands", [(0.1, True), (0.2, False)])
def test_a_gap_under_feet_must_be_within_their_reach(width, stands):
    """Hind feet nominally over its middle: they must get half its width and half a foot farther."""
    assert (at(moat(width), 0.35)[ALONG] == "stands") == stands


def test_a_gap_between_feet_is_stepped_over():
    verdict = at(moat(0.5), 0.0)
    assert verdict[ALONG] == verdict[ACROSS] == "stands"


def test_who_fits_stands_on_the_floor_of_a_pit():
    """A label does not say that one gets there."""
    assert at(moat(1.2), 0.0) == ["stands"] * 8


@pytest.mark.parametrize("x, along, across", [(-0.26, False, True), (-0.4, True, True), (-0.1, False, False)])
def test_beside_a_wall_stands_who_does_not_reach_into_it(x, along, across):
    """The body is 0.35 m long and 0.2 m wide from its middle."""
    verdict = at(ledge(1.0), x)
    assert (verdict[ALONG] == "stands", verdict[ACROSS] == "stands") == (along, across)


@pytest.mark.parametrize("height, expected", [(0.28, "stands"), (0.32, "clearance")])
def test_a_box_under_the_body_must_leave_it_clear(height, expected):
    box = tile(lambda x, y: height * ((x.abs() < 0.08) & (y.abs() < 0.05)))
    assert at(box, 0.0)[ALONG] == expected


def test_clearance_counts_from_the_body_on_a_slope():
    """A box of 0.25 m on a slope, seen from the plane through the feet: level ground's 0.25 m, and not more."""
    slope = tile(lambda x, y: 0.5 * x + 0.25 * ((x.abs() < 0.08) & (y.abs() < 0.05)))
    assert at(slope, 0.0)[ALONG] == "stands"


@pytest.mark.parametrize("height, expected", [(0.15, "stands"), (0.25, "step")])
def test_a_bar_between_feet_is_a_step(height, expected):
    assert at(tile(lambda x, y: height * (x.abs() < 0.03)), 0.0)[ALONG] == expected


def test_a_slope_is_no_step():
    """A robot whose steps are lower than what a slope rises within the length of a step."""
    low = RobotConfig(step_height=0.03)
    assert at(tile(lambda x, y: 0.5 * x), 0.0, robot=low)[ALONG] == "stands"


def sole_of(depths, robot=ROBOT):
    """Whether ground carries that lies so deep at a disc's 13 points."""
    good, _ = carrying(-torch.tensor(depths, dtype=torch.float32)[:, None], robot)
    return bool(good)


def test_a_foot_may_hang_over_a_drop_by_a_quarter():
    x, y = (disc(ROBOT.foot_radius) / (ROBOT.foot_radius / 2)).round().t()
    assert len(x) == 13
    assert sole_of((x > 1).float().tolist())  # 1 of 13 points
    assert sole_of(((x + y) > 1).float().tolist())  # 3
    assert not sole_of((x > 0).float().tolist())  # 4


def test_a_foot_does_not_rest_on_a_spike():
    assert not sole_of([1.0] * 6 + [0.0] + [1.0] * 6)
    assert sole_of([0.0] * 6 + [1.0] + [0.0] * 6)  # over a hole it does


def test_a_foot_rests_on_small_bumps_alone():
    """Bumps without a slope; their standard deviation may be a sixth of the radius, 5 mm."""
    x, y = (disc(ROBOT.foot_radius) / (ROBOT.foot_radius / 2)).round().t()
    ring = x.square() + y.square()
    bumps = torch.where(ring == 1, -1.0, torch.where(ring == 0, 0.0, 1.0))  # 1 in the middle, 4 below, 8 above
    deviation = float(bumps.std(correction=0))
    assert sole_of((0.0049 / deviation * bumps).tolist()) and not sole_of((0.0051 / deviation * bumps).tolist())


@given(st.integers(0, 10_000))
def test_soles_are_the_planes_of_what_carries(seed):
    rng = np.random.default_rng(seed)
    points = disc(0.03).double()
    z = torch.from_numpy(rng.normal(0, 0.01, (13, 5)) + 0.4 * points[:, :1].numpy() + 1.0)
    found = sole(z, points, 0.03)
    for n in range(5):
        carries = (z[:, n].max() - z[:, n] <= 0.03).numpy()
        if carries.sum() < 6:
            continue  # do not tell a plane
        A = np.column_stack([np.ones(13), points.numpy()])[carries]
        (height, *gradient), *_ = np.linalg.lstsq(A, z[carries, n].numpy(), rcond=None)
        residual = z[carries, n].numpy() - A @ [height, *gradient]
        assert float(found.support[n]) == pytest.approx(carries.mean())
        assert found.gradient[:, n].tolist() == pytest.approx(gradient, abs=1e-9)
        assert float(found.height[n]) == pytest.approx(height, abs=1e-9)
        assert float(found.roughness[n]) == pytest.approx(math.sqrt((residual**2).mean()), abs=1e-9)


def test_the_nearest_foothold_of_each_level():
    """One row of nodes; a foot reaches two nodes on. Levels are 0.1 m; nodes 3 and 6 do not carry."""
    row = torch.tensor([0.0, 0.0, 0.05, -torch.inf, 0.5, 0.5, -torch.inf, 0.52, 0.5])
    height = torch.full((5, 9), -torch.inf)
    height[2] = row
    chosen, levels = within_reach(height, 2, 0.1)
    assert levels.tolist() == [2, 2, 2, 1, 1]  # of nodes 2 to 6
    assert (chosen - 2 * 9).tolist() == [[2, 4], [4, 2], [4, 2], [5, 5], [7, 7]]  # of two as near the higher


@pytest.mark.parametrize("robot, height", [(ROBOT, 0.4), (SMALL, 0.25)])
def test_turned_and_mirrored_ground_gives_turned_and_mirrored_labels(robot, height):
    """But for the choice between footholds as near and as high, a few stances in a thousand."""
    heights, xy = blocks(0, height).heights, places(1, 300)
    ids, x, y = torch.tensor([0]), *xy.unbind(-1)
    found = stand(HeightField(heights, RESOLUTION), ids, xy, [robot])
    assert 0.2 < found.float().mean() < 0.8
    turned = HeightField(heights.transpose(1, 2).flip(1), RESOLUTION)
    result = stand(turned, ids, torch.stack([-y, x], -1), [robot])
    assert (result.roll(4, -1) != found).float().mean() < 0.002
    result = stand(HeightField(heights.flip(2), RESOLUTION), ids, torch.stack([x, -y], -1), [robot])
    assert (result.flip(-1).roll(1, -1) != found).float().mean() < 0.002


def test_altitude_does_not_matter():
    field, xy, ids = blocks(2, 0.25), places(3, 200), torch.tensor([0])
    high = HeightField(field.heights + 512, RESOLUTION)
    assert (stand(field, ids, xy, [ROBOT]) != stand(high, ids, xy, [ROBOT])).float().mean() < 0.002


def test_a_batch_is_each_robot_by_itself():
    field = HeightField(torch.cat([blocks(4, 0.3).heights, blocks(5, 0.2).heights]), RESOLUTION)
    ids, robots = torch.tensor([1, 0, 1]), [ROBOT, SMALL, SMALL]
    xy = torch.cat([places(seed, 70) for seed in (6, 7, 8)])
    found = stand(field, ids, xy, robots, headings=6)
    assert found.shape == (3, 70, 6) and found.dtype == torch.bool
    for b in range(3):
        for some in (slice(0, 1), slice(10, 70)):
            single = stand(field, ids[b : b + 1], xy[b : b + 1, some].double(), [robots[b]], headings=6)
            assert torch.equal(single[0], found[b, some])


def test_no_places_have_no_labels():
    field = blocks(0, 0.1)
    assert stand(field, torch.tensor([0]), torch.zeros(1, 0, 2), [ROBOT]).shape == (1, 0, 8)
    assert stand(field, torch.zeros(0, dtype=torch.int64), torch.zeros(0, 3, 2), []).shape == (0, 3, 8)


@pytest.mark.parametrize(
    "change, message",
    [
        ({"xy": torch.zeros(1, 3)}, "tile_ids, xy, robots: must be"),
        ({"robots": [ROBOT, ROBOT]}, "robots: must be"),
        ({"tile_ids": torch.tensor([1])}, "tile_ids: must be from 0 to 0"),
        ({"xy": torch.full((1, 2, 2), torch.nan)}, "xy: must be finite"),
        ({"xy": torch.tensor([[[0.0, 0.0], [500.0, 500.0]]])}, "xy: must lie within"),
        ({"headings": 0}, "headings: must be a positive int"),
    ],
)
def test_refuses(change, message):
    good = dict(field=blocks(0, 0.1), tile_ids=torch.tensor([0]), xy=torch.zeros(1, 2, 2), robots=[ROBOT], headings=8)
    with pytest.raises(ValueError, match=message):
        stand(**(good | change))


class Slow:
    """The same criteria in loops over one robot's feet, points and footholds, float64."""

    def __init__(self, field, robot):
        self.heights, self.robot = field.heights[0].double().numpy(), robot
        self.sole = functools.cache(self._sole)
        self.height = functools.cache(self._height)

    def _height(self, x, y):
        n = len(self.heights)
        u, v = (min(max(a / RESOLUTION + (n - 1) / 2, 0), n - 1) for a in (x, y))
        i, j = min(int(u), n - 2), min(int(v), n - 2)
        (a, b), (c, d) = self.heights[i : i + 2, j : j + 2]
        u, v = u - i, v - j
        return a * (1 - u) * (1 - v) + b * (1 - u) * v + c * u * (1 - v) + d * u * v

    def _sole(self, i, j):
        """(x, y, z, dz/dx, dz/dy) of a foot at node (i, j), None where it does not carry."""
        r, steepest, x, y = self.robot.foot_radius, math.tan(self.robot.max_slope), i / 50, j / 50
        points = [(a * r / 2, b * r / 2) for a in range(-2, 3) for b in range(-2, 3) if a * a + b * b <= 4]
        z = np.array([self.height(x + dx, y + dy) for dx, dy in points])
        carries = z >= z.max() - 2 * r * steepest
        A = np.column_stack([np.ones(13), points])[carries]
        plane, *_ = np.linalg.lstsq(A, z[carries], rcond=None)
        rough = math.sqrt(((z[carries] - A @ plane) ** 2).mean()) > r / 6
        if carries.mean() < 0.75 or math.hypot(*plane[1:]) > steepest or rough:
            return None
        return x, y, *plane

    def footholds(self, x, y):
        """The nearest on the upper and on the lower level within reach."""
        i, j, reach = round(x * 50), round(y * 50), self.robot.foot_reach
        n, span = int(reach * 50 + 1e-6), 2 * reach * math.tan(self.robot.max_slope)
        around = [(a, b) for a in range(-n, n + 1) for b in range(-n, n + 1) if a * a + b * b <= n * n]
        there = [(a * a + b * b, self.sole(i + a, j + b)) for a, b in around]
        there = [(distance, -sole[2], sole) for distance, sole in there if sole is not None]
        if not there:
            return []
        highest, lowest = (f(sole[2] for *_, sole in there) for f in (max, min))
        upper = min(entry for entry in there if entry[2][2] >= highest - span)
        return {upper[2], min(entry for entry in there if entry[2][2] <= lowest + span)[2]}

    def stands(self, x, y, theta):
        cos, sin = math.cos(theta), math.sin(theta)
        length, width = self.robot.length, self.robot.width
        corners = [(a * length / 2, b * width / 2) for a, b in ((1, 1), (1, -1), (-1, -1), (-1, 1))]
        choices = [self.footholds(x + a * cos - b * sin, y + a * sin + b * cos) for a, b in corners]
        return any(self.stance(feet, x, y, cos, sin) for feet in itertools.product(*choices))

    def stance(self, feet, x, y, cos, sin):
        p = np.array(feet)
        (c, gx, gy), *_ = np.linalg.lstsq(np.column_stack([np.ones(4), p[:, :2] - (x, y)]), p[:, 2], rcond=None)
        if math.hypot(gx, gy) > math.tan(self.robot.max_slope):
            return False
        length, width = self.robot.length, self.robot.width
        for a, side in zip(range(4), (width, length, width, length), strict=True):
            if self.step(p[a], p[(a + 1) % 4], side) > self.robot.step_height:
                return False
        n, m = round(length / 0.08), round(width / 0.08)
        nodes = math.ceil(math.hypot(length / n, width / m) / 2 * 50 - 1e-6)
        for k, q in itertools.product(range(n), range(m)):
            along, across = ((k + 0.5) / n - 0.5) * length, ((q + 0.5) / m - 0.5) * width
            dx, dy = along * cos - across * sin, along * sin + across * cos
            if self.highest(x + dx, y + dy, nodes) - (c + gx * dx + gy * dy) > self.robot.clearance:
                return False
        return True

    def highest(self, x, y, nodes):
        i, j, around = round(x * 50), round(y * 50), range(-nodes, nodes + 1)
        return max(self.height((i + a) / 50, (j + b) / 50) for a in around for b in around)

    def step(self, a, b, side):
        if a[2] > b[2]:
            a, b = b, a
        points = math.ceil((side + 2 * self.robot.foot_reach) / 0.04)
        dx, dy = (b[:2] - a[:2]) / points
        h = [a[2], *(self.highest(a[0] + k * dx, a[1] + k * dy, 1) for k in range(1, points)), b[2]]
        rise = max(max(h[: k + 4]) - max(h[: k + 1]) for k in range(points - 2))
        return rise - 3 * max(0, (dx * (a[3] + b[3]) + dy * (a[4] + b[4])) / 2)


@pytest.mark.parametrize("robot", [ROBOT, SMALL])
@pytest.mark.parametrize("height", [0.2, 0.35, 0.5])
def test_against_slow_loops(robot, height):
    field, xy = blocks(round(100 * height), height), places(9, 6)
    found = stand(field, torch.tensor([0]), xy, [robot], headings=4)[0]
    slow = Slow(field, robot)
    expected = [[slow.stands(x, y, k * math.pi / 4) for k in range(4)] for x, y in xy[0].double().tolist()]
    assert found.tolist() == expected


def test_the_lattice_covers_what_it_must():
    lattice = lattice_around(torch.tensor([[0.011, -0.495], [0.31, 0.195]]), 0.1)
    p = lattice.places(torch.device("cpu"))
    assert p[0, 0].tolist() == pytest.approx([-0.1, -0.6]) and p[-1, -1].tolist() == pytest.approx([0.42, 0.3])
    assert int(lattice.node(torch.tensor(-0.1), torch.tensor(-0.581))) == 1
    assert int(lattice.node(torch.tensor(-0.081), torch.tensor(-0.6))) == p.shape[1]


def test_every_criterion_decides_on_rough_ground():
    xy = places(0, 300)
    tall = [
        verdicts(blocks(k, h), torch.tensor([0]), xy, [r]) for k, (h, r) in enumerate([(0.25, ROBOT), (0.4, SMALL)])
    ]
    low = verdicts(blocks(3, 0.2), torch.tensor([0]), xy, [RobotConfig(clearance=0.1, step_height=0.3)])
    counts = torch.bincount(torch.cat([low, *tall]).flatten(), minlength=len(VERDICTS))
    assert (counts[1:] > 50).all()


def test_drops_agree_where_it_is_plain():
    """On flat ground it stands, without ground under its hind feet it falls."""
    pytest.importorskip("mujoco")
    from training.traversability.labels.drop import drop, on_footholds, on_nominal_places

    xy, theta = torch.tensor([0.02, 0.01]), 0.3
    flat, cliff = tile(lambda x, y: 0.2), tile(lambda x, y: -1.0 * (x < 0.02))
    ground = ground_around(flat, 0, xy[None], ROBOT)
    feet = stances(ground, xy[None], torch.tensor([theta]), ROBOT).feet[0]
    posture = on_footholds(flat, 0, feet, xy, theta, ROBOT)
    assert posture.position.tolist() == pytest.approx([0.02, 0.01, 0.5], abs=0.001)
    outcome = drop(flat, 0, posture, ROBOT, 0.9)
    assert outcome.stood(ROBOT) and outcome.moved < 0.002 and outcome.tilted < 0.002
    assert not drop(cliff, 0, on_nominal_places(cliff, 0, xy, 0.0, ROBOT), ROBOT, 0.9).stood(ROBOT)


def test_nominal_postures_keep_to_what_legs_can_do():
    """A foot over a hole hangs half a step below the body's plane, which is no steeper than its limit."""
    from training.traversability.labels.drop import on_nominal_places, rest_heights

    hole, middle = tile(lambda x, y: -1.0 * ((x > 0.2) & (y > 0.1))), torch.zeros(2)
    posture = on_nominal_places(hole, 0, middle, 0.0, ROBOT)
    assert math.acos(float(posture.rotation[2, 2])) == pytest.approx(0.5, abs=1e-4)
    x, y, z = (posture.rotation.t() @ (posture.balls - posture.position).t()) / posture.rotation[2, 2]
    below = z + ROBOT.clearance - ROBOT.foot_radius / posture.rotation[2, 2]  # the body's plane, vertically
    # Without limits the gradient is (-1 / 1.4, -1 / 0.8), of which 0.3795 are kept, and the hind right foot 0.25 below.
    assert below.tolist() == pytest.approx([-0.1, 0.1, -0.25 + (1 - 0.3795) * 0.5, 0.1], abs=1e-3)
    over = posture.balls[:, 2] - rest_heights(hole, 0, posture.balls[:, :2], ROBOT.foot_radius)
    assert float(over.min()) == pytest.approx(0.0005, abs=1e-5) and over[0] > 0.5


def test_a_body_that_touches_does_not_stand():
    pytest.importorskip("mujoco")
    from training.traversability.labels.drop import Outcome, drop, on_nominal_places

    box = tile(lambda x, y: 0.31 * ((x.abs() < 0.08) & (y.abs() < 0.05)))
    outcome = drop(box, 0, on_nominal_places(box, 0, torch.zeros(2), 0.0, ROBOT), ROBOT, 0.9)
    assert outcome.touched and not outcome.stood(ROBOT)
    assert Outcome(0.04, 0.09, False).stood(ROBOT) and not Outcome(0.04, 0.09, True).stood(ROBOT)
    assert not Outcome(0.06, 0.09, False).stood(ROBOT) and not Outcome(0.04, 0.11, False).stood(ROBOT)


def test_a_robot_slides_where_the_friction_does_not_hold():
    pytest.importorskip("mujoco")
    from training.traversability.labels.drop import drop, on_nominal_places

    slope = tile(lambda x, y: 0.5 * x)
    posture = on_nominal_places(slope, 0, torch.tensor([0.0, 0.0]), 0.0, ROBOT)
    assert torch.allclose(posture.rotation[:, 2], torch.tensor([-0.5, 0.0, 1.0]) / math.sqrt(1.25), atol=1e-4)
    assert drop(slope, 0, posture, ROBOT, 0.55).stood(ROBOT)
    assert not drop(slope, 0, posture, ROBOT, 0.4).stood(ROBOT)


def test_legs_that_cut_the_ground_are_counted():
    from training.traversability.labels.drop import legs_clear, on_footholds

    posture = on_footholds(tile(lambda x, y: 0.0), 0, torch.tensor(
        [[0.25, 0.2, 0], [0.25, -0.2, 0], [-0.35, -0.2, 0], [-0.35, 0.2, 0]]), torch.zeros(2), 0.0, ROBOT)  # fmt: skip
    wall = tile(lambda x, y: 0.25 * ((x > 0.28) & (x < 0.33)))  # between front feet and the corners above them
    assert legs_clear(tile(lambda x, y: 0.0), 0, posture, ROBOT) and not legs_clear(wall, 0, posture, ROBOT)


def test_balls_rest_on_what_they_touch_first():
    from training.traversability.labels.drop import rest_heights

    ball = rest_heights(ledge(0.1), 0, torch.tensor([[-1.0, 0.0], [1.0, 0.0]]), 0.03)
    assert ball.tolist() == pytest.approx([0.03, 0.13], abs=1e-6)
    slope = rest_heights(tile(lambda x, y: 0.5 * x), 0, torch.tensor([[0.1, 0.0]]), 0.03)
    assert float(slope) == pytest.approx(0.05 + 0.03 * math.sqrt(1.25), abs=2e-4)


def test_agreement_by_hand():
    from training.traversability.physics import summarize, table

    def row(kind, verdict, stood, limit):
        return {"kind": kind, "verdict": verdict, "stood": stood, "stood_at_limit": limit, "legs_clear": stood}

    result = summarize([
        row("a", "stands", True, False), row("a", "stands", True, True), row("a", "step", True, False),
        row("b", "stands", False, False), row("b", "slope", False, False),
    ])  # fmt: skip
    assert result["all"] == {
        "standing": 3, "not_standing": 2, "stood": 2, "fell": 1, "agreement": 0.6,
        "stood_at_limit": 1, "fell_at_limit": 2, "agreement_at_limit": 0.6,
    }  # fmt: skip
    assert result["by_kind"]["a"]["agreement"] == pytest.approx(2 / 3) and result["legs_clear"] == pytest.approx(2 / 3)
    assert result["by_verdict"]["step"]["fell_at_limit"] == 1
    assert "| a | 2 | 2 | 1 | 1 | 0 | 1 | 66.7 % | 66.7 % |" in table(result)


def test_a_tile_gives_stances_of_both_labels():
    pytest.importorskip("mujoco")
    from training.traversability.physics import rows_of_tile

    field = tile(lambda x, y: -1.0 * (x.remainder(1.1) < 0.5), 8.0)
    rows = rows_of_tile(field, "moats", ROBOT, 2, np.random.default_rng(0))
    assert [row["verdict"] == "stands" for row in rows] == [True, False]
    assert [row["stood"] for row in rows] == [True, False]
