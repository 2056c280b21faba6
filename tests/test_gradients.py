"""Gradients through measure and forward, with every default stage on."""

import numpy as np
import pytest
import torch

from tests.helpers import off_borders, pose, random_state, small_map
from torchelev.pipeline import rate

CELLS = (6, 5)


def scene(seed=0, per_cell=3, unknown=(0, 0)):
    """A float64 map of nearly flat ground that is known but for one cell, and a cloud far from gates and borders.

    Three points per cell and a known prior: enough for the drift compensation to act.
    """
    rng = np.random.default_rng(seed)
    emap = small_map(1, CELLS, dtype=torch.float64)
    centers = emap.cell_centers()[0].numpy().reshape(-1, 2)
    xy = off_borders(np.repeat(centers, per_cell, 0) + rng.uniform(-0.04, 0.04, (len(centers) * per_cell, 2)), 0.1, 0.2)
    in_map = np.column_stack([xy, 0.02 + rng.normal(0, 0.002, len(xy))])
    T = pose((0.02, 0.03, 1.0), yaw=0.4, pitch=0.1)
    cloud = (torch.from_numpy(in_map) - T[0, :3, 3]) @ T[0, :3, :3]
    known = torch.ones(1, *CELLS, dtype=torch.bool)
    known[0, unknown[0], unknown[1]] = False
    state = emap.state._replace(
        elevation=torch.where(known, torch.from_numpy(rng.normal(0, 0.002, (1, *CELLS))), 0.0),
        variance=torch.full((1, *CELLS), 1e-4, dtype=torch.float64),
        validity=known,
        support=torch.full((1, *CELLS), 5.0, dtype=torch.float64),
        has_normal=known,
        traversability=torch.ones(1, *CELLS, dtype=torch.float64),
        rated=known,
    )
    return emap, state, cloud[None], T


def fused(emap, state, points, prior, T):
    """The state after one scan, as a function of the points and of the elevation before."""
    return emap(state._replace(elevation=prior), emap.measure(points, T, T, 0.1))


def test_gradients_flow_to_points_and_prior():
    emap, state, cloud, T = scene()
    points, prior = cloud.requires_grad_(), state.elevation.clone().requires_grad_()
    after = fused(emap, state, points, prior, T)
    assert after.statistics.drift_correction.item() > 0.01 and after.validity.all()
    assert after.statistics.points_used.item() == points.shape[1]
    (after.elevation * torch.linspace(1, 2, 30, dtype=torch.float64).view(1, *CELLS)).sum().backward()
    assert points.grad.isfinite().all() and prior.grad.isfinite().all()
    along_z = points.grad @ T[0, 2, :3]
    assert (along_z != 0).all(), "every point moves the map"
    assert (prior.grad[state.validity] != 0).all() and prior.grad[~state.validity].abs().max() == 0


def test_gradcheck_of_points_and_prior():
    emap, state, cloud, T = scene()
    points, prior = cloud.requires_grad_(), state.elevation.clone().requires_grad_()
    assert torch.autograd.gradcheck(
        lambda p, h: fused(emap, state, p, h, T).elevation, (points, prior), eps=1e-7, atol=1e-6, fast_mode=True
    )


@pytest.mark.slow(1)
@pytest.mark.parametrize("layer", ["variance", "gradient_x", "gradient_y", "traversability"])
def test_gradcheck_of_the_other_layers(layer):
    emap, state, cloud, T = scene(1)
    points, prior = cloud.requires_grad_(), state.elevation.clone().requires_grad_()
    assert torch.autograd.gradcheck(
        lambda p, h: getattr(fused(emap, state, p, h, T), layer), (points, prior), eps=1e-7, atol=1e-5, fast_mode=True
    )


@pytest.mark.slow(1)
def test_gradcheck_in_full_without_drift():
    """Every entry of the Jacobian; where drift acts, each point moves every cell."""
    emap, state, cloud, T = scene(2, per_cell=1)
    points, prior = cloud.requires_grad_(), state.elevation.clone().requires_grad_()
    assert torch.autograd.gradcheck(
        lambda p, h: fused(emap, state, p, h, T).elevation, (points, prior), eps=1e-7, atol=1e-6
    )


def test_gradients_over_many_updates_stay_finite():
    emap, state, _, _ = scene()
    clouds = []
    for k in range(3):
        _, _, cloud, T = scene(k)
        clouds.append(cloud.requires_grad_())
        state = emap(state, emap.measure(cloud, T, T, 0.3))
    sum(getattr(state, n).sum() for n in ("elevation", "variance", "gradient_x", "traversability")).backward()
    assert all(c.grad.isfinite().all() and c.grad.abs().max() > 0 for c in clouds)


def test_gradients_on_a_blank_float32_map():
    emap = small_map(2)
    rng = np.random.default_rng(0)
    cloud = torch.from_numpy(rng.uniform(-0.4, 0.4, (2, 200, 3)) - [0, 0, 1]).float().requires_grad_()
    after = emap(emap.state, emap.measure(cloud, pose(num_envs=2), pose(num_envs=2), 0.1))
    for name in ("elevation", "variance", "gradient_x", "gradient_y", "traversability"):
        (grad,) = torch.autograd.grad(getattr(after, name).sum(), cloud, retain_graph=True)
        assert grad.isfinite().all(), name
        assert grad.abs().max() > 0 or name == "traversability", name  # nothing there can be walked on


@pytest.mark.parametrize("value", [1e30, 0.0, 1e-30])
def test_rejected_points_have_no_gradient(value):
    emap, state, cloud, T = scene()
    cloud = torch.cat([cloud, torch.full((1, 3, 3), value, dtype=torch.float64)], 1).requires_grad_()
    fused(emap, state, cloud, state.elevation, T).elevation.sum().backward()
    assert cloud.grad.isfinite().all() and cloud.grad[:, -3:].abs().max() == 0 and cloud.grad.abs().max() > 0


@pytest.mark.parametrize("value", [torch.nan, torch.inf])
def test_padding_has_no_gradient(value):
    emap, state, cloud, T = scene()
    cloud = torch.cat([cloud, torch.full((1, 3, 3), value, dtype=torch.float64)], 1).requires_grad_()
    fused(emap, state, cloud, state.elevation, T).elevation.sum().backward()
    assert cloud.grad.isfinite().all() and cloud.grad[:, -3:].abs().max() == 0


def test_the_upper_bound_can_be_differentiated():
    emap, state, cloud, T = scene(unknown=(2, 2))
    cloud = cloud.requires_grad_()
    bound = emap.layer("upper_bound", state=fused(emap, state, cloud, state.elevation, T))
    bound.nan_to_num().sum().backward()
    assert cloud.grad.isfinite().all()


def test_gradients_of_poses():
    """The map is differentiable in where the sensor stood, too."""
    emap, state, cloud, T = scene()
    T = T.clone().requires_grad_()
    m = emap.measure(cloud, T, T.detach(), 0.1)
    emap(state, m).elevation.sum().backward()
    assert T.grad.isfinite().all() and T.grad[0, 2, 3] > 0


# Reading --------------------------------------------------------------------------------------------------------------


def reading(seed=0):
    emap = small_map(2, CELLS, dtype=torch.float64)
    state = random_state(np.random.default_rng(seed), emap.cfg.grid, 2, known=0.8)
    rng = np.random.default_rng(seed + 1)
    xy = off_borders(rng.uniform(-0.3, 0.3, (40, 2)) + 0.05, 0.1) - 0.05  # off the lines between cell centres
    return emap, state, torch.from_numpy(xy).view(2, 20, 2)


def test_gradcheck_of_sample():
    emap, state, xy = reading()
    valid = emap.sample(xy, state=state)[1]
    assert valid.any() and not valid.all()

    def read(elevation, places):
        return emap.sample(places, state=state._replace(elevation=elevation))[0]

    inputs = (state.elevation.clone().requires_grad_(), xy.requires_grad_())
    assert torch.autograd.gradcheck(read, inputs, eps=1e-7, atol=1e-6)
    (grad,) = torch.autograd.grad(read(*inputs).sum(), inputs[1])
    assert (grad[valid].abs().sum(-1) > 0).any() and grad[~valid].abs().max() == 0


@pytest.mark.parametrize("layer", ["elevation", "normal_x", "normal_z", "upper_bound"])
def test_samples_of_layers_have_finite_gradients(layer):
    emap, state, xy = reading()
    floats = {n: v.clone().requires_grad_() for n, v in state._asdict().items() if n in ("elevation", "gradient_x")}
    emap.sample(xy, layer, state=state._replace(**floats))[0].sum().backward()
    grads = [v.grad for v in floats.values() if v.grad is not None]
    assert grads and all(g.isfinite().all() for g in grads) and any(g.abs().max() > 0 for g in grads)


def test_layers_have_finite_gradients_despite_their_nans():
    emap, state, _ = reading()
    elevation = state.elevation.clone().requires_grad_()
    layer = emap.layer("elevation", state=state._replace(elevation=elevation))
    layer[state.validity].sum().backward()
    assert torch.equal(elevation.grad, state.validity.double())


@pytest.mark.parametrize("stage", ["normals", "traversability"])
def test_gradients_of_flat_ground_are_finite(stage):
    """Square roots and angles at exactly zero slope, and cells without neighbours."""
    emap, state, _ = reading()
    validity = state.validity.clone()
    validity[1] = False
    validity[1, 2, 2] = True
    elevation = torch.zeros_like(state.elevation, requires_grad=True)
    state = state._replace(elevation=elevation, validity=validity)
    after = rate(state, emap.cfg)
    read = after.gradient_x + after.gradient_y if stage == "normals" else after.traversability
    read.sum().backward()
    assert elevation.grad.isfinite().all()
