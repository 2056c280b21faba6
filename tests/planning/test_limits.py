"""Step, slope and clearance: each is enforced by itself, whatever the rating, and named."""

import math

import pytest
import torch

from tests.planning.maps import ground_map, place
from torchelev import (
    ElevationMap,
    ElevationMapConfig,
    GridConfig,
    LearnedTraversabilityConfig,
    RobotConfig,
    TraversabilityConfig,
)
from torchelev.pipeline import rate
from torchelev.planning.footprint import FootprintConfig, check_footprint, unsafe_area
from torchelev.planning.limits import Limit, compute_steps, find_obstacles, limits_of
from torchelev.planning.path_check import check_path
from torchelev.planning.path_reason import Reason
from torchelev.planning.planner import plan
from torchelev.planning.traversal_cost import TraversalCostConfig, traversal_cost

ANY_RATING = TraversalCostConfig(min_traversability=0.0)
ANY_GROUND = FootprintConfig(min_traversability=0.0, max_unsafe=1.0, max_unknown=1.0)
LOOSE = TraversabilityConfig(critical_step=0.35, critical_slope=1.5, critical_roughness=math.inf)
CLIMBER = TraversabilityConfig.of_robot(RobotConfig(step_height=0.16))
FOOTPRINT = torch.tensor([[0.3, 0.2], [-0.3, 0.2], [-0.3, -0.2], [0.3, -0.2]])
RESOLUTIONS = [0.02, 0.04, 0.05, 0.1]


def world(height, resolution=0.1, head=LOOSE, known=None, size=3.0, dtype=torch.float32):
    """A map of heights [m], a function of x and y [m] as grids, rated by its head."""
    cfg = ElevationMapConfig(grid=GridConfig(resolution=resolution, length_x=size, length_y=size), traversability=head)
    emap = ElevationMap(cfg).to(dtype)
    x, y = emap.cell_centers()[0].double().unbind(-1)
    emap.elevation.copy_(height(x, y))
    emap.validity.copy_(torch.ones_like(emap.validity) if known is None else known(x, y))
    emap.variance.fill_(1e-4)
    emap.load_state(rate(emap.state, cfg))
    return emap


def walk(emap, cfg=None, ends=((-0.8, 0.05), (0.8, 0.05))):
    return plan(emap, place(*ends[0]), place(*ends[1]), cfg)


def straight(emap, cfg=None, yaw=0.0):
    """The check of a straight path along x."""
    poses = torch.stack([torch.linspace(-0.8, 0.8, 50), torch.full((50,), 0.05), torch.full((50,), yaw)], -1)[None]
    return check_path(emap, poses, FOOTPRINT, cfg)


def stairs(rise, run=0.3):
    return lambda x, y: rise * torch.floor((x + 0.01) / run)


# Steps ----------------------------------------------------------------------------------------------------------------


@pytest.mark.slow(3)
@pytest.mark.parametrize("resolution", RESOLUTIONS)
@pytest.mark.parametrize("height", [
    lambda x, y: torch.where(x > 0, -0.71, 0.0),
    lambda x, y: torch.where(x > 0, 0.71, 0.0),
    lambda x, y: torch.where(x + y > 0, -0.71, 0.0),  # at 45 degrees: no step is crossed from corner to corner either
    lambda x, y: torch.where(x.abs() <= 0.051, 0.71, 0.0),
    lambda x, y: torch.where(x.abs() <= 0.051, -0.71, 0.0),
], ids=["cliff", "wall", "cliff at 45 degrees", "thin wall", "ditch"])  # fmt: skip
def test_no_plan_crosses_a_known_step(resolution, height):
    emap = world(height, resolution)
    for cfg in (None, ANY_RATING):
        path = walk(emap, cfg)
        assert path.reason.tolist() == [Reason.NO_PATH] and path.limit.tolist() == [Limit.STEP]
        assert "steps are higher than the robot" in path.explain()[0]
    for cfg in (None, ANY_GROUND):
        check = straight(emap, cfg)
        assert not check.safe and "a step of 0.71 m exceeds the robot's 0.35 m" in check.explain()[0]
    assert len(unsafe_area(emap, torch.tensor([[[[-0.3, -0.2], [0.3, -0.2], [0.3, 0.2]]]]), ANY_GROUND)[0][0])


@pytest.mark.slow(1)
@pytest.mark.parametrize("resolution", RESOLUTIONS)
def test_a_step_below_the_limit_is_crossed(resolution):
    emap = world(lambda x, y: torch.where(x > 0, 0.3, 0.0), resolution)
    assert walk(emap, ANY_RATING).reached and straight(emap, ANY_GROUND).safe


@pytest.mark.slow(1)
@pytest.mark.parametrize("resolution", RESOLUTIONS)
@pytest.mark.parametrize("gap", [1, -1])
def test_unknown_cells_are_no_bridge(resolution, gap):
    """A line of unknown cells along a cliff, below the robot too, which assumes unknown ground to be passable."""
    half = 0.51 * resolution
    emap = world(
        lambda x, y: torch.where(x > 0, -0.71, 0.0), resolution, known=lambda x, y: (x - gap * half).abs() > half
    )
    for ends in (
        ((-0.8, 0.05), (0.8, 0.05)),
        ((gap * half, 0.05), (-gap * 0.8, 0.05)),
        ((gap * half, 0.05), (0.8, 0.0)),
    ):
        path = walk(emap, ANY_RATING, ends)
        xy = path.xy[0, : path.count[0]]
        sides = {bool(x > 0) for x in xy[:, 0] if abs(x - gap * half) > half}
        assert len(sides) <= 1, "from the upper to the lower side"
    assert not straight(emap, ANY_GROUND).safe


def test_a_wide_map_of_unknown_cells_has_no_steps():
    emap = world(lambda x, y: torch.zeros_like(x), known=lambda x, y: torch.zeros_like(x, dtype=torch.bool))
    assert compute_steps(emap.elevation, emap.validity, 0.1).eq(0).all()
    assert all(layer.eq(0).all() for layer in find_obstacles(emap.state, emap.cfg))


def test_half_precision():
    emap = world(lambda x, y: 40 + torch.where(x > 0, -0.71, 0.0), dtype=torch.float16)
    assert walk(emap, ANY_RATING).limit.tolist() == [Limit.STEP] and not straight(emap, ANY_GROUND).safe


# Slope and clearance --------------------------------------------------------------------------------------------------


def ramp(degrees, top=0.5):
    return lambda x, y: math.tan(math.radians(degrees)) * x.clamp(-top, top)


@pytest.mark.slow(1)
@pytest.mark.parametrize("resolution", RESOLUTIONS)
@pytest.mark.parametrize("degrees, passes", [(15, True), (26, True), (35, False), (45, False)])
def test_slopes(resolution, degrees, passes):
    """The robot's limit is 0.5 rad = 28.6 degrees."""
    emap = world(ramp(degrees), resolution, CLIMBER)
    path, check = walk(emap, ANY_RATING), straight(emap, ANY_GROUND)
    assert bool(path.reached) == passes and bool(check.safe) == passes
    if not passes:
        assert path.limit.tolist() == [Limit.SLOPE] and "steeper than the robot" in path.explain()[0]
        assert "a slope of" in check.explain()[0] and "exceeds its 29" in check.explain()[0]


@pytest.mark.slow(1)
@pytest.mark.parametrize("resolution", RESOLUTIONS)
def test_the_ground_beside_a_wall_is_not_steep(resolution):
    emap = world(lambda x, y: torch.where(y > 0.45, 0.8, 0.0), resolution, CLIMBER)
    assert walk(emap).reached and straight(emap).safe


@pytest.mark.slow(1)
@pytest.mark.parametrize("resolution", [0.02, 0.05, 0.1])
def test_clearance(resolution):
    """A ridge of two low steps is as high as the belly."""
    head = TraversabilityConfig.of_robot(RobotConfig(step_height=0.2, clearance=0.25, max_slope=1.2))
    emap = world(lambda x, y: 0.16 * ((x.abs() < 0.21).double() + (x.abs() < 0.11).double()), resolution, head)
    path, check = walk(emap, ANY_RATING), straight(emap, ANY_GROUND)
    assert path.limit.tolist() == [Limit.CLEARANCE] and "belly" in path.explain()[0]
    low = world(lambda x, y: 0.1 * ((x.abs() < 0.21).double() + (x.abs() < 0.11).double()), resolution, head)
    assert walk(low, ANY_RATING).reached and straight(low, ANY_GROUND).safe
    assert not check.safe and check.footprints.clearance.max() == pytest.approx(0.3, abs=0.03)
    assert "above that below the feet exceeds its clearance, 0.25 m" in check.explain()[0]


# Stairs and flat ground -----------------------------------------------------------------------------------------------


@pytest.mark.slow(1)
@pytest.mark.parametrize("resolution", RESOLUTIONS)
@pytest.mark.parametrize("rise, passes", [(0.08, True), (0.12, True), (0.17, False), (0.2, False)])
def test_stairs_of_a_climber(resolution, rise, passes):
    emap = world(stairs(rise), resolution, CLIMBER)
    assert bool(walk(emap).reached) == passes and bool(straight(emap).safe) == passes


@pytest.mark.parametrize("head", [TraversabilityConfig(), CLIMBER], ids=["default", "climber"])
@pytest.mark.parametrize("sigma", [0.01, 0.02])
def test_noisy_flat_ground_stays_traversable(head, sigma):
    generator = torch.Generator().manual_seed(0)
    emap = world(lambda x, y: sigma * torch.randn(x.shape, generator=generator), 0.04, head)
    assert walk(emap).reached and straight(emap).safe


# Whose limits ---------------------------------------------------------------------------------------------------------


def test_the_heads_robot_sets_the_limits():
    robot = RobotConfig(step_height=0.16, max_slope=0.4, clearance=0.2)
    for head in (TraversabilityConfig.of_robot(robot), LearnedTraversabilityConfig(robot=robot)):
        assert limits_of(ElevationMapConfig(traversability=head)) == (0.16, 0.4, 0.2)
    assert limits_of(ElevationMapConfig()) == (0.2, 0.7, math.inf)
    assert limits_of(ElevationMapConfig(traversability=None)) == (math.inf,) * 3


def test_without_limits_the_rating_alone_decides():
    head = TraversabilityConfig(critical_slope=math.inf, critical_step=math.inf, critical_roughness=math.inf)
    assert walk(world(lambda x, y: torch.where(x > 0, -0.71, 0.0), head=head)).reached


@pytest.mark.parametrize("where, reason", [
    ((0.05, 0.05), Reason.GOAL_IMPASSABLE),
    ((0.85, 0.05), Reason.NO_PATH),
])  # fmt: skip
def test_the_limit_is_that_of_the_place(where, reason):
    emap = world(lambda x, y: torch.where(x > 0, -0.71, 0.0))
    path = walk(emap, ANY_RATING, ((-0.8, 0.05), where))
    assert path.reason.tolist() == [reason] and path.limit.tolist() == [Limit.STEP]


def test_what_is_only_badly_rated_has_no_limit():
    emap = ground_map()
    emap.traversability[0, 8] = 0.0
    path = plan(emap, place(-0.5, 0.5), place(0.5, 0.5))
    assert path.limit.tolist() == [Limit.NONE] and path.explain() == [Reason.NO_PATH.sentence]


def test_a_robot_leaves_a_place_beyond_its_limits():
    """Its own cell is passable."""
    emap = world(lambda x, y: torch.where((x.abs() < 0.051) & (y.abs() < 0.051), 0.5, 0.0))
    cost = traversal_cost(emap, ANY_RATING, start=torch.tensor([[15, 15]]))
    assert cost[0, 15, 15].isfinite() and cost[0, 15, 16].isinf() and cost[0, 15, 18].isfinite()


def test_a_footprint_reads_what_its_ground_asks():
    emap = world(lambda x, y: 0.2 * x + 0.1 * ((x - 0.05).abs() < 0.04) * ((y - 0.05).abs() < 0.04), 0.1, CLIMBER)
    check = check_footprint(emap, FOOTPRINT.view(1, 1, 4, 2), ANY_GROUND)
    assert check.step.item() == pytest.approx(0.12, abs=1e-4)
    assert check.slope.item() == pytest.approx(math.atan(0.2), abs=0.05)
    assert check.clearance.item() == pytest.approx(0.1, abs=0.02)
    assert check.limit.item() == Limit.NONE
    steep = check_footprint(world(lambda x, y: 0.9 * x, 0.1, CLIMBER), FOOTPRINT.view(1, 1, 4, 2), ANY_GROUND)
    assert steep.limit.item() == Limit.SLOPE
