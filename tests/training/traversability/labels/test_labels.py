"""Where robots can stand: hand-worked ground, symmetries, batches and errors."""

import math

import pytest
import torch

from tests.training.traversability.labels.ground import RESOLUTION, ROBOT, SMALL, blocks, ledge, places, tile
from torchelev.robot import RobotConfig
from torchelev.sim import HeightField
from training.traversability.labels.labels import can_stand, verdicts
from training.traversability.labels.stances import VERDICTS

ALONG, ACROSS = 0, 4  # of 8 headings: the body along x, and along y


def at(field, x, y=0.003, robot=ROBOT):
    """What stops the robot at one place, by name, for each of 8 headings."""
    found = verdicts(field, torch.tensor([0]), torch.tensor([[[x, y]]]), [robot])
    return [VERDICTS[number] for number in found.flatten()]


@pytest.mark.slow(1)
@pytest.mark.parametrize("robot", [ROBOT, SMALL])
def test_on_flat_ground_all_stand(robot):
    field = HeightField(torch.full((2, 2, 2), 3.0), 0.5)
    xy = torch.tensor([[[0.0, 0.0], [0.013, -0.2], [7.0, 5.0]], [[-0.31, 0.27], [0.1, 0.1], [0.0, -9.0]]])
    assert can_stand(field, torch.tensor([1, 0]), xy, [robot, robot]).tolist() == [[[True] * 8] * 3] * 2


@pytest.mark.slow(1)
@pytest.mark.parametrize("height", [0.02, 0.1, 0.15, 0.19, 0.21])
@pytest.mark.parametrize("heading", [ALONG, ACROSS])
def test_across_a_ledge_stands_who_can_step_on_it(height, heading):
    """Along, front feet stand 0.7 m ahead on the ledge; across, one side's, 0.4 m apart: atan(0.21 / 0.4) < 0.5."""
    assert at(ledge(height), 0.01)[heading] == ("stands" if height <= 0.2 else "step")


@pytest.mark.slow(1)
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


@pytest.mark.slow(1)
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


@pytest.mark.slow(1)
@pytest.mark.parametrize("robot, height", [(ROBOT, 0.4), (SMALL, 0.25)])
def test_turned_and_mirrored_ground_gives_turned_and_mirrored_labels(robot, height):
    """But for the choice between footholds as near and as high, a few stances in a thousand."""
    heights, xy = blocks(0, height).heights, places(1, 300)
    ids, x, y = torch.tensor([0]), *xy.unbind(-1)
    found = can_stand(HeightField(heights, RESOLUTION), ids, xy, [robot])
    assert 0.2 < found.float().mean() < 0.8
    turned = HeightField(heights.transpose(1, 2).flip(1), RESOLUTION)
    result = can_stand(turned, ids, torch.stack([-y, x], -1), [robot])
    assert (result.roll(4, -1) != found).float().mean() < 0.002
    result = can_stand(HeightField(heights.flip(2), RESOLUTION), ids, torch.stack([x, -y], -1), [robot])
    assert (result.flip(-1).roll(1, -1) != found).float().mean() < 0.002


def test_altitude_does_not_matter():
    field, xy, ids = blocks(2, 0.25), places(3, 200), torch.tensor([0])
    high = HeightField(field.heights + 512, RESOLUTION)
    assert (can_stand(field, ids, xy, [ROBOT]) != can_stand(high, ids, xy, [ROBOT])).float().mean() < 0.002


@pytest.mark.slow(1)
def test_a_batch_is_each_robot_by_itself():
    field = HeightField(torch.cat([blocks(4, 0.3).heights, blocks(5, 0.2).heights]), RESOLUTION)
    ids, robots = torch.tensor([1, 0, 1]), [ROBOT, SMALL, SMALL]
    xy = torch.cat([places(seed, 70) for seed in (6, 7, 8)])
    found = can_stand(field, ids, xy, robots, headings=6)
    assert found.shape == (3, 70, 6) and found.dtype == torch.bool
    for b in range(3):
        for some in (slice(0, 1), slice(10, 70)):
            single = can_stand(field, ids[b : b + 1], xy[b : b + 1, some].double(), [robots[b]], headings=6)
            assert torch.equal(single[0], found[b, some])


def test_no_places_have_no_labels():
    field = blocks(0, 0.1)
    assert can_stand(field, torch.tensor([0]), torch.zeros(1, 0, 2), [ROBOT]).shape == (1, 0, 8)
    assert can_stand(field, torch.zeros(0, dtype=torch.int64), torch.zeros(0, 3, 2), []).shape == (0, 3, 8)


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
        can_stand(**(good | change))


def test_every_criterion_decides_on_rough_ground():
    xy = places(0, 300)
    tall = [
        verdicts(blocks(k, h), torch.tensor([0]), xy, [r]) for k, (h, r) in enumerate([(0.25, ROBOT), (0.4, SMALL)])
    ]
    low = verdicts(blocks(3, 0.2), torch.tensor([0]), xy, [RobotConfig(clearance=0.1, step_height=0.3)])
    counts = torch.bincount(torch.cat([low, *tall]).flatten(), minlength=len(VERDICTS))
    assert (counts[1:] > 50).all()
