"""Levels as values: `forward` with them is an update, and ceilings are differentiable in what measured them."""

import numpy as np
import pytest
import torch

from tests.helpers import off_borders, pose, small_map
from tests.levels.walks import line, look, make_map
from torchelev import HeightScan, LevelsConfig, MapImage, SensorConfig
from torchelev.levels.state import Levels
from torchelev.sim.exact import covered_scenes

CELLS = (6, 5)
TABLE = covered_scenes.table()


def table(seed=0, **stages):
    """A float64 map of flat ground below a table of 0.9 m, both known, and a cloud of two points per cell on each."""
    rng = np.random.default_rng(seed)
    stages |= dict(levels=LevelsConfig(separation="gap", min_support=1.0), sensor=SensorConfig(exclusion=None))
    emap = small_map(1, CELLS, dtype=torch.float64, **stages)
    T = pose((0.02, 0.03, 0.5), yaw=0.4, pitch=0.1)

    def cloud(height):
        xy = emap.cell_centers()[0].numpy().reshape(-1, 2).repeat(4, 0)
        xy = off_borders(xy + rng.uniform(-0.04, 0.04, xy.shape), 0.1, 0.2)
        z = np.tile([0.02, height], len(xy) // 2) + rng.normal(0, 0.002, len(xy))
        places = np.column_stack([xy, z])
        return ((torch.from_numpy(places) - T[0, :3, 3]) @ T[0, :3, :3])[None]

    for k in range(2):
        emap.update(cloud(0.9), T, T, dt=0.1 * k)
    return emap, cloud(0.9), T


def fused(emap, points, T, levels=None):
    levels = emap.levels.in_windows(emap.state) if levels is None else levels
    return emap(emap.state, emap.measure(points, T, T, 0.1), levels)


READERS = {
    "ceiling": lambda emap, T, **given: emap.layer("ceiling", **given),
    "clearance": lambda emap, T, **given: emap.layer("clearance", **given),
    "elevation of level 0": lambda emap, T, **given: emap.layer("elevation", level=0, **given),
    "underside of level 1": lambda emap, T, **given: emap.layer("underside", level=1, **given),
    "variance of level 1": lambda emap, T, **given: emap.layer("variance", level=1, **given),
    "a scan": lambda emap, T, **given: HeightScan.points([(0.0, 0.0), (0.1, 0.1)], surface="ceiling", no_ceiling=2.0)(
        emap, T, **given
    )[0],
    "an image": lambda emap, T, **given: MapImage(length_x=0.2, length_y=0.2, resolution=0.1, layers=("clearance",))(
        emap, T, **given
    ),
    "a sample": lambda emap, T, **given: emap.sample(torch.tensor([[[0.05, 0.05]]]), "clearance", **given)[0],
}


@pytest.mark.slow(4)
@pytest.mark.parametrize("name", READERS)
def test_gradcheck_of_points_and_surfaces(name):
    emap, points, T = table()
    levels = emap.levels.in_windows(emap.state)

    def read(cloud, lower, upper):
        state, after = fused(emap, cloud, T, levels._replace(lower=lower, upper=upper))
        values = READERS[name](emap, T, state=state, levels=after)
        assert values.isfinite().all() and (after.support > 0).sum() == 30
        return values

    inputs = tuple(value.clone().requires_grad_() for value in (points, levels.lower, levels.upper))
    assert torch.autograd.gradcheck(read, inputs, eps=1e-7, atol=1e-6, fast_mode=True)


def test_a_ceiling_moves_with_the_points_that_measured_it_and_with_no_others():
    emap, points, T = table(drift=None)
    points, T_map_sensor = points.requires_grad_(), T.clone().requires_grad_()
    levels = emap.levels.in_windows(emap.state)
    state, after = emap(emap.state, emap.measure(points, T_map_sensor, T, 0.1), levels)
    ceiling = emap.layer("ceiling", state=state, levels=after)
    of_points, of_pose = torch.autograd.grad(ceiling.sum(), (points, T_map_sensor))
    hits_table = points[0] @ T[0, 2, :3] + T[0, 2, 3] > 0.5
    along_z = of_points[0] @ T[0, 2, :3]
    assert (along_z[hits_table] > 0).all()
    assert (of_points[0][~hits_table] == 0).all()
    assert of_pose.isfinite().all()
    assert of_pose[0, 2, 3] > 0
    assert not after.free_top.requires_grad


def test_drift_compensation_carries_the_ceiling_along():
    emap, points, T = table()
    points = points.requires_grad_()
    state, after = fused(emap, points, T)
    assert state.statistics.drift_correction != 0
    (grad,) = torch.autograd.grad(emap.layer("ceiling", state=state, levels=after).sum(), points)
    assert (grad[0] @ T[0, 2, :3] > 0).all()


@pytest.mark.slow(2)
def test_gradients_of_scans_whose_rays_separate_surfaces_are_finite():
    emap = make_map().double()
    state, levels, clouds = emap.state, emap.levels.in_windows(emap.state), []
    for k, place in enumerate(line((0.5, 0.0, 0.0), (1.0, 0.0, 0.0), 2)):
        points, *poses = look(TABLE, *place, seed=k)
        clouds.append(points.double().requires_grad_())
        state, levels = emap(state, emap.measure(clouds[-1], *poses, dt=0.2), levels)
    ceiling = emap.layer("ceiling", state=state, levels=levels)
    ceiling[ceiling.isfinite()].sum().backward()
    assert ceiling.isfinite().sum() > 50
    assert all(cloud.grad.isfinite().all() and (cloud.grad != 0).any(-1).sum() > 100 for cloud in clouds)


@pytest.mark.slow(2)
def test_transforms_differentiate_ceilings():
    emap, points, T = table()

    def total(cloud):
        state, after = fused(emap, cloud, T)
        return emap.layer("ceiling", state=state, levels=after).sum()

    expected = torch.autograd.grad(total(cloud := points.clone().requires_grad_()), cloud)[0]
    torch.testing.assert_close(torch.func.grad(total)(points), expected)


# Levels as values -----------------------------------------------------------------------------------------------------


@pytest.mark.slow(2)
def test_forward_with_levels_is_an_update():
    updated, pure = make_map(2), make_map(2)
    state, levels = pure.state, pure.levels.in_windows(pure.state)
    for k, place in enumerate(line((-1.0, 0.0, 0.0), (1.0, 0.1, 0.0), 4)):
        points, *poses = (part.repeat(2, *[1] * (part.ndim - 1)) for part in look(TABLE, *place, seed=k))
        points[1] += 0.01 * k
        alone = updated(updated.state, updated.measure(points, *poses, dt=0.2))
        updated.update(points, *poses, dt=0.2)
        state, levels = pure(state, pure.measure(points, *poses, dt=0.2), levels)
        assert torch.equal(alone.validity, updated.validity)
    assert not pure.validity.any()
    assert not pure.levels.support.any()
    assert torch.equal(state.validity, updated.validity)
    assert torch.equal(state.statistics.rejected_overhang, updated.statistics.rejected_overhang)
    torch.testing.assert_close(state.elevation, updated.elevation, rtol=0, atol=2e-5)
    for name, value in updated.levels.in_windows(updated.state)._asdict().items():
        torch.testing.assert_close(getattr(levels, name), value, rtol=0, atol=2e-5, msg=name)
    pure.load_state(state, levels)
    for name in ("ceiling", "clearance", "elevation"):
        torch.testing.assert_close(pure.layer(name), pure.layer(name, state=state, levels=levels), equal_nan=True)


def test_a_map_without_levels_takes_none():
    plain, (emap, points, T) = small_map(1, CELLS, dtype=torch.float64), table()
    levels, m = emap.levels.in_windows(emap.state), plain.measure(points, T, T, 0.1)
    assert plain(plain.state, m).validity.any()
    with pytest.raises(ValueError, match="levels: must be left out for a map without levels"):
        plain(plain.state, m, levels)
    with pytest.raises(ValueError, match="levels: must be left out for a map without levels"):
        plain.load_state(plain.state, levels)


def test_levels_of_other_maps_are_refused():
    emap, points, T = table()
    levels, m = emap.levels.in_windows(emap.state), emap.measure(points, T, T, 0.1)
    two = Levels(*(value.repeat(2, *[1] * (value.ndim - 1)) for value in levels))
    for wrong in (two, levels._replace(lower=levels.lower.float())):
        with pytest.raises(ValueError, match=r"levels: expected \(1, 2, 6, 5\) of torch.float64"):
            emap(emap.state, m, wrong)
        with pytest.raises(ValueError, match="levels: expected"):
            emap.layer("ceiling", levels=wrong)
        with pytest.raises(ValueError, match="levels: expected"):
            emap.load_state(emap.state, wrong)
    with pytest.raises(TypeError, match=r"levels: must be Levels, got MapLevels; give emap.levels.in_windows"):
        emap.layer("ceiling", levels=emap.levels)
