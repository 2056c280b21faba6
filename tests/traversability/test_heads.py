"""The analytic head."""

import dataclasses
import math

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from tests import reference
from tests.helpers import pose, random_state, small_config, small_map, terrain
from torchelev import ElevationMapConfig, GridConfig, LearnedTraversabilityConfig, RobotConfig, TraversabilityConfig
from torchelev.pipeline import rate
from torchelev.plane_fit import known_ground
from torchelev.state import blank_state
from torchelev.traversability.heads import find_steps


@given(st.integers(0, 10_000), st.sampled_from([0.05, 0.1, 0.2]), st.floats(0.2, 1.0), st.floats(1, 10))
def test_agrees_with_the_reference(seed, radius, known, forgiving):
    cfg = TraversabilityConfig(radius=radius, critical_step=0.2 * forgiving, critical_roughness=0.05 * forgiving)
    critical = {k: v for k, v in dataclasses.asdict(cfg).items() if k != "robot"}
    grid = small_map(1, (7, 6)).cfg.grid
    state = random_state(np.random.default_rng(seed), grid, 2, known)
    after = rate(state, small_config((7, 6), traversability=cfg))
    got = after.traversability
    for b, i, j in np.ndindex(2, 7, 6):
        expected = 0.0
        if state.validity[b, i, j]:
            elevation, validity = state.elevation[b].numpy(), state.validity[b].numpy()
            rated = reference.traversability(elevation, validity, i, j, 0.1, **critical)
            assert bool(after.rated[b, i, j]) == (rated is not None)
            expected = rated or 0.0
        assert float(got[b, i, j]) == pytest.approx(expected, abs=1e-4)  # the square roots are clamped


def test_flat_is_traversable_and_a_step_is_not():
    emap = small_map(1, (20, 10))
    state = emap.state._replace(validity=torch.ones_like(emap.validity))
    state.elevation[:, 12:] = 0.3
    result = rate(state, emap.cfg).traversability
    assert result[0, :10].min() > 0.99 and result[0, 11:13].max() == 0 and result[0, 15:].min() > 0.99


@given(st.integers(0, 10_000), st.integers(1, 3))
def test_steps(seed, radius):
    state = random_state(np.random.default_rng(seed), small_map(1, (6, 5)).cfg.grid)
    ground = known_ground(state.elevation, state.validity, radius)
    got = find_steps(ground, radius)
    for i, j in np.ndindex(6, 5):
        if state.validity[0, i, j]:
            expected = reference.step_at(state.elevation[0].numpy(), state.validity[0].numpy(), i, j, radius)
            assert float(got[0, i, j]) == pytest.approx(expected, abs=1e-6)


def rated(height, resolution, cfg):
    """The analytic head's rating of known ground (H, W)."""
    H, W = height.shape
    grid = GridConfig(resolution=resolution, length_x=H * resolution, length_y=W * resolution)
    map_cfg = ElevationMapConfig(grid=grid, traversability=cfg)
    state = blank_state(grid, 1, "cpu", torch.float32)
    state = state._replace(elevation=height.float()[None], validity=torch.ones_like(state.validity))
    return rate(state, map_cfg).traversability[0]


def x_of(resolution, size=2.4):
    """x [m] of the cells of a square map."""
    number = round(size / resolution)
    return ((torch.arange(number, dtype=torch.float64) + 0.5 - number / 2) * resolution)[:, None].expand(-1, number)


@pytest.mark.parametrize("resolution", [0.02, 0.04, 0.05, 0.1])
@pytest.mark.parametrize("height", [0.2, 0.8, -0.8])
def test_a_step_counts_whatever_the_plane(resolution, height):
    only_steps = TraversabilityConfig(critical_slope=math.inf, critical_step=0.2, critical_roughness=math.inf)
    rating = rated(torch.where(x_of(resolution) > 0, height, 0.0), resolution, only_steps)
    assert rating[:, 5].min() < 1e-6 and rating[0].min() == 1
    middle = len(rating) // 2
    wall = torch.zeros_like(rating)
    wall[middle] = height  # of one cell: a wall or a ditch
    assert rated(wall, resolution, only_steps)[middle - 1 : middle + 2].max() < 1e-6


@pytest.mark.parametrize("resolution", [0.02, 0.04, 0.05, 0.1])
@pytest.mark.parametrize("diagonal", [False, True])
def test_smooth_slopes_are_no_steps(resolution, diagonal):
    """A slope of 30 degrees is rated by its inclination alone."""
    x = x_of(resolution)
    along = (x + x.T) / math.sqrt(2) if diagonal else x
    rating = rated(math.tan(math.radians(30)) * along, resolution, TraversabilityConfig())
    assert rating[8:-8, 8:-8].sub(1 - math.radians(30) / 0.7).abs().max() < 1e-4


def test_a_wider_window_does_not_widen_steps():
    """Two steps of 12 cm, 20 cm apart, are none of 24 cm."""
    x = x_of(0.04)
    height = 0.12 * (x > 0) + 0.12 * (x > 0.2)
    only_steps = TraversabilityConfig(radius=0.3, critical_slope=math.inf, critical_step=0.2, critical_roughness=1e3)
    assert rated(height, 0.04, only_steps).min() == pytest.approx(0.4, abs=1e-3)


def test_a_map_without_the_head_knows_no_traversability():
    emap = small_map(1, traversability=None)
    cloud = torch.from_numpy(terrain(np.random.default_rng(0), 200))[None] - torch.tensor([0, 0, 1])
    emap.update(cloud, pose(), dt=0.0)
    assert emap.layer("elevation").isfinite().any()
    assert emap.layer("traversability").isnan().all()


@pytest.mark.parametrize("name", ["radius", "critical_slope", "critical_step", "critical_roughness"])
@pytest.mark.parametrize("value", [0.0, -0.1, math.nan])
def test_refuses(name, value):
    with pytest.raises(ValueError, match=f"traversability.{name}: must be positive"):
        TraversabilityConfig(**{name: value})


@pytest.mark.parametrize("slope", [math.pi / 2, 2.5, 35.0])
def test_a_slope_is_below_a_right_angle(slope):
    with pytest.raises(ValueError, match="critical_slope: must be below pi / 2, got .* or inf to switch it off"):
        TraversabilityConfig(critical_slope=slope)


def test_refuses_what_is_no_robot():
    with pytest.raises(TypeError, match="traversability.robot: must be a RobotConfig"):
        TraversabilityConfig(robot={"step_height": 0.16})


# A robot's critical values --------------------------------------------------------------------------------------------


@pytest.mark.parametrize("resolution", [0.02, 0.04, 0.05, 0.1])
def test_a_climber_takes_its_steps_and_no_higher_ones(resolution):
    cfg = TraversabilityConfig.of_robot(RobotConfig(step_height=0.16))
    x = x_of(resolution, 3.6)
    for height, passes in ((0.12, True), (0.16, True), (0.18, False), (0.4, False)):
        stairs = height * torch.floor(x / 0.3)
        assert (rated(stairs, resolution, cfg)[8:-8, 8:-8].min() >= 0.3) == passes, height


def test_a_robot_survives_files_of_settings():
    robot = RobotConfig(step_height=0.5, max_slope=1.2)
    cfg = ElevationMapConfig(traversability=TraversabilityConfig.of_robot(robot))
    assert cfg.traversability.critical_slope == math.inf
    assert ElevationMapConfig.from_dict(cfg.to_dict()) == cfg
    learned = ElevationMapConfig.from_dict({"traversability": {"robot": {"length": 0.8}}}).traversability
    assert learned == LearnedTraversabilityConfig(robot=RobotConfig(length=0.8))
