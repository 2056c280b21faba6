"""Other floors near the robot."""

from dataclasses import asdict

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from tests import reference
from tests.helpers import nans, pose, random_state, seen_from, small_map
from torchelev import OverlapConfig
from torchelev.stages.overlap.stage import clear_other_floors
from torchelev.stages.recenter.stage import recenter


def random_floors(rng, emap, known):
    """Poses, a measurement without points, and a state some of whose cells were just hit."""
    B, grid = emap.num_envs, emap.cfg.grid
    T = torch.cat([pose((*rng.uniform(-2, 2, 2), rng.uniform(-0.3, 1.5))) for _ in range(B)])
    m = emap.measure(nans(B), T, T, 0.1)
    state = random_state(rng, grid, B, known=known)._replace(corner=recenter(emap.state, m, grid).corner)
    return (
        T,
        m,
        state._replace(time=state.time * torch.from_numpy(rng.random(state.time.shape) < rng.choice([0.5, 1.0]))),
    )


@given(
    st.integers(0, 10_000),
    st.floats(0.1, 0.8),
    st.floats(0.05, 0.4),
    st.floats(0.0, 0.3),
    st.floats(0.3, 0.8),
)
def test_agrees_with_the_reference(seed, radius, height, base_height, max_base_height):
    rng = np.random.default_rng(seed)
    emap = small_map(2, (7, 6), dtype=torch.float64)
    T, m, state = random_floors(rng, emap, rng.choice([0.1, 0.6, 1.0]))
    corner = state.corner
    cfg = OverlapConfig(radius=radius, height=height, base_height=base_height, max_base_height=max_base_height)
    after = clear_other_floors(state, m, emap.cfg.grid, cfg)
    for b in range(2):
        layers = {n: getattr(state, n)[b].numpy() for n in ("elevation", "upper_bound", "validity", "bounded", "time")}
        settings = asdict(cfg)
        del settings["square"]
        validity, bounded, cleared = reference.clear_other_floors(
            layers, T[b, :3, 3].numpy(), corner[b].tolist(), 0.1, **settings
        )
        np.testing.assert_array_equal(after.validity[b], validity)
        np.testing.assert_array_equal(after.bounded[b], bounded)
        assert after.statistics.cleared_other_floors[b] == cleared


def upstairs_map():
    """A map at z = 0 of which everything is known, and a robot 3 m above it."""
    emap = small_map(1)
    emap.load_state(random_state(np.random.default_rng(0), emap.cfg.grid, known=1.0))
    return emap, pose((0, 0, 3.0))


def test_update_clears_the_floor_below():
    emap, T = upstairs_map()
    emap.update(nans(1), T, T, 0.1)
    assert emap.layer("elevation").isnan().all() and emap.statistics.cleared_other_floors.item() == 120


def test_without_a_base_nothing_is_cleared():
    emap, T = upstairs_map()
    emap.update(nans(1), T, None, 0.1)
    assert not emap.layer("elevation").isnan().any() and emap.statistics.cleared_other_floors.item() == 0


def test_the_count_is_that_of_the_last_update():
    emap, T = upstairs_map()
    emap.update(nans(1), T, T, 0.1)
    emap.update(nans(1), T, None, 0.1)
    assert emap.statistics.cleared_other_floors.item() == 0


def test_bounds_that_were_cleared_do_not_count():
    emap, T = upstairs_map()
    emap.validity.fill_(False)
    emap.bounded.fill_(True)
    emap.update(nans(1), T, T, 0.1)
    assert emap.layer("upper_bound").isnan().all() and emap.statistics.cells_bounded.item() == 0


# Whose ground is whose ------------------------------------------------------------------------------------------------

CELLS = (60, 60)  # 6 m x 6 m around the robot


def around(height, known=None, time=1.0, num_envs=1):
    """A map of 6 m x 6 m around the origin: height(x, y) [m] where known(x, y), last hit `time` [s] ago."""
    emap = small_map(num_envs, CELLS)
    x, y = emap.cell_centers().float().unbind(-1)
    z = torch.as_tensor(height(x, y)).float().expand(x.shape).clone()
    validity = torch.ones_like(z, dtype=torch.bool) if known is None else known(x, y)
    blank = emap.state
    time = torch.as_tensor(time(x, y) if callable(time) else time).float().expand(x.shape).clone()
    return emap, blank._replace(elevation=z * validity, validity=validity, time=time, support=validity * 9.0)


def cleared(emap, state, base_z, cfg=None):
    """Which cells go with the base at (0, 0, base_z), (B, H, W)."""
    T = pose((0.0, 0.0, base_z), num_envs=len(state.elevation))
    m = emap.measure(nans(len(T)), T, T, 0.1)
    after = clear_other_floors(state, m, emap.cfg.grid, cfg or OverlapConfig())
    return state.validity & ~after.validity


def ring(inner, outer=9.0):
    return lambda x, y: (x.hypot(y) > inner) & (x.hypot(y) < outer)


@pytest.mark.parametrize("base", [0.0, 0.5, 1.0, 1.8, 2.4])
@pytest.mark.parametrize("known", [None, ring(1.5)], ids=["all known", "blind spot"])
@pytest.mark.parametrize("time", [0.0, 5.0])
def test_a_robot_of_any_height_keeps_its_ground(base, known, time):
    emap, state = around(lambda x, y: 0.05 * (5 * x).sin(), known, time)
    assert not cleared(emap, state, base + 0.06).any()


@pytest.mark.parametrize("base", [0.5, 1.8])
@pytest.mark.parametrize("slope, behind", [(-0.45, 0.0), (0.45, 0.0), (-0.25, 5.0), (0.25, 5.0)])
def test_a_slope_is_one_floor(base, slope, behind):
    """24 degrees in view of a lidar, 14 degrees of which a camera sees the part ahead."""
    emap, state = around(lambda x, y: slope * x, time=lambda x, y: behind * (x < 0))
    assert not cleared(emap, state, base).any()


def test_on_a_bridge_the_ground_below_goes():
    """Ground 1.5 m below the deck was seen before, under the robot too; the deck is seen ahead."""
    deck = ring(0.5)
    emap, state = around(
        lambda x, y: 1.5 * (deck(x, y) & (x > y.abs())), time=lambda x, y: 9.0 * ~(deck(x, y) & (x > y.abs()))
    )
    x, y = emap.cell_centers().unbind(-1)
    assert torch.equal(cleared(emap, state, 2.05), (state.elevation == 0) & (x.hypot(y) <= 3.0))


@pytest.mark.parametrize("base", [0.5, 1.8])
def test_beside_a_wall_and_furniture_the_ground_stays(base):
    emap, state = around(lambda x, y: 1.5 * (y > 0.8) + 0.7 * ((x < -1) & (y <= 0.8)), ring(0.8), 0.0)
    assert not cleared(emap, state, base).any()


@pytest.mark.parametrize("base", [0.5, 1.8])
def test_upstairs_the_floor_below_goes(base):
    """Seen ahead, the robot's own floor; everywhere else what was seen before it came up."""
    ahead = ring(0.5, 2.5)
    emap, state = around(
        lambda x, y: 2.72 * (ahead(x, y) & (x > y.abs())),
        time=lambda x, y: 9.0 * ~(ahead(x, y) & (x > y.abs())),
    )
    gone = cleared(emap, state, 2.72 + base)
    x, y = emap.cell_centers().unbind(-1)
    assert torch.equal(gone, (state.elevation == 0) & (x.hypot(y) <= 3.0))


@pytest.mark.parametrize("base", [0.5, 1.8])
def test_downstairs_the_floor_above_goes(base):
    ahead = ring(0.5, 2.5)
    emap, state = around(
        lambda x, y: 2.72 * ~(ahead(x, y) & (x > y.abs())),
        time=lambda x, y: 9.0 * ~(ahead(x, y) & (x > y.abs())),
    )
    gone = cleared(emap, state, base)
    x, y = emap.cell_centers().unbind(-1)
    assert torch.equal(gone, (state.elevation > 0) & (x.hypot(y) <= 3.0))


@pytest.mark.parametrize("base", [0.5, 1.8])
def test_through_a_stairwell_the_floor_below_is_another(base):
    """The robot's own floor around it was seen before; this scan hits the lower floor alone."""
    emap, state = around(lambda x, y: -2.72 * (x > 1.0), time=lambda x, y: 3.0 * (x <= 1.0))
    gone = cleared(emap, state, base)
    x, y = emap.cell_centers().unbind(-1)
    assert not (gone & (x <= 1.0)).any()
    assert gone[(x > 1.0) & (x.hypot(y) <= 3.0)].all()


@pytest.mark.parametrize("depth", [0.8, 1.5])
def test_at_the_edge_of_a_pit_the_ground_stays(depth):
    """Only the pit is in view, and the ground behind was seen before."""
    emap, state = around(lambda x, y: -depth * (x > 0.3), time=lambda x, y: 3.0 * (x <= 0.3))
    for base in (0.5, 1.8):
        x = emap.cell_centers()[..., 0]
        assert not (cleared(emap, state, base) & (x <= 0.3)).any()


def test_what_a_flying_robot_sees_stays():
    """Ten metres up nothing is the robot's floor: neither ground nor roofs go, a ceiling of long ago does."""
    emap, state = around(lambda x, y: 6.0 * (x > 1.0) + 13.0 * (y > 2.0), time=0.0)
    stale = state._replace(time=torch.where(state.elevation > 10, 5.0, 0.0))
    x, y = emap.cell_centers().unbind(-1)
    assert torch.equal(cleared(emap, stale, 10.0), (state.elevation > 10) & (x.hypot(y) <= 3.0))


def test_environments_and_places_are_independent():
    """A tall robot, one upstairs and one without a pose; far from the origin and high up, the same cells go."""
    emap, state = around(lambda x, y: 0 * x, time=5.0, num_envs=3)
    for shift in (0.0, 1000.0):
        moved = state._replace(corner=state.corner + 10_000 * int(shift > 0), elevation=state.elevation + shift)
        T = torch.cat([pose((shift, shift, shift + z)) for z in (1.8, 4.0, torch.nan)])
        m = emap.measure(nans(3), torch.nan_to_num(T), torch.nan_to_num(T), 0.1)
        m = m._replace(base=torch.where(T[:, :3, 3].isnan(), torch.nan, m.base))
        gone = moved.validity & ~clear_other_floors(moved, m, emap.cfg.grid, OverlapConfig()).validity
        assert not gone[0].any() and not gone[2].any()
        x, y = emap.cell_centers()[1].unbind(-1)
        assert torch.equal(gone[1], x.hypot(y) <= 3.0)


def test_the_pose_of_a_tall_sensor_given_as_the_base_keeps_the_ground():
    """In whole updates: a lidar 1.8 m above flat ground."""
    emap, T = small_map(1, CELLS), pose((0.0, 0.0, 1.8))
    rng = np.random.default_rng(0)
    for _ in range(3):
        points = np.column_stack([rng.uniform(-3, 3, (20_000, 2)), rng.normal(0, 0.01, 20_000)])
        emap.update(seen_from(T, points).float(), T, T, 0.1)
    assert emap.layer("elevation").isfinite().float().mean() > 0.99


BAD = [dict(radius=0.0), dict(height=-1.0), dict(base_height=-0.1), dict(max_base_height=0.1)]


@pytest.mark.parametrize("bad", BAD)
def test_refuses(bad):
    with pytest.raises(ValueError, match=f"overlap.{next(iter(bad))}"):
        OverlapConfig(**bad)
