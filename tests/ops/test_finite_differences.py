"""Every layer that is a number, differentiated by every input that is one, against finite differences."""

import numpy as np
import pytest
import torch

from tests.helpers import pose, seen_from, small_map
from torchelev import DriftConfig, LearnedTraversabilityConfig, TraversabilityConfig
from torchelev.state import MapState

CELLS = (6, 5)
DISCRETE = (
    "corner",
    "elapsed",
    "validity",
    "bounded",
    "has_normal",
    "rated",
    "challenger_support",
)  # masks and integers
LAYERS = [name for name in MapState._fields[:-1] if name not in (*DISCRETE, "challenger")]  # which has no gradient
NUMBERS = ["drift_error", "drift_correction"]
LAST_ROW = torch.tensor([0.0, 0.0, 0.0, 1.0], dtype=torch.float64)
HEADS = {"analytic": TraversabilityConfig(), "learned": LearnedTraversabilityConfig(), "none": None}
STEP = 1e-6  # relative to each entry of an input


def hollow_scene(head, sensors, base=True):
    """Known ground around unknown cells, which rays bound; drift acts. Returns outputs as a function, and inputs."""
    rng = np.random.default_rng(sensors)
    emap = small_map(1, CELLS, 0.1, torch.float64, drift=DriftConfig(min_points=10), traversability=head)
    known = torch.ones(1, *CELLS, dtype=torch.bool)
    known[0, 1:4, 1:4] = False
    xy = np.repeat(emap.cell_centers()[known].numpy(), 3, 0) + rng.uniform(-0.04, 0.04, (63, 2))
    in_map = np.column_stack([xy, 0.02 + rng.normal(0, 0.002, len(xy))])
    places = [(0.02 - 0.037 * s, 0.03, 1.0 + 0.1 * s) for s in range(sensors)]
    T = torch.cat([pose(place, yaw=0.4 + s, pitch=0.1, roll=0.05) for s, place in enumerate(places)])
    cloud = torch.cat([seen_from(T[s : s + 1], in_map) for s in range(sensors)])[None]

    def draw(low, high):
        return torch.from_numpy(rng.uniform(low, high, (1, *CELLS)))

    state = emap.state._replace(
        base_height=torch.tensor([0.3], dtype=torch.float64),
        elevation=draw(-0.004, 0.004) * known,
        variance=torch.where(known, draw(1e-4, 2e-4), 1.0),
        validity=known,
        support=5.0 * known.double(),
        time=draw(0.1, 0.3),
        upper_bound=draw(0.1, 1.5),
        bounded=draw(0, 1) < 0.5,
        gradient_x=draw(-0.02, 0.02) * known,
        gradient_y=draw(-0.02, 0.02) * known,
        traversability=draw(0.8, 0.9) * known,
        pose_covariance=1e-5 * torch.eye(3, dtype=torch.float64)[None],
    )
    prior = {f"prior {name}": getattr(state, name).clone() for name in LAYERS}
    inputs = prior | dict(
        points=cloud,
        T_map_sensor=T[None, :, :3].clone(),
        T_map_base=pose((0.01, 0.02, 0.6))[:, :3],
        dt=torch.tensor([0.1], dtype=torch.float64),
        variance=torch.from_numpy(rng.uniform(1e-4, 4e-4, cloud.shape[:-1])),
        pose_covariance=(1e-5 * torch.eye(6, dtype=torch.float64) + 1e-6).repeat(1, sensors, 1, 1),
    )

    def run(values):
        before = state._replace(**{name: values[f"prior {name}"] for name in LAYERS})
        T_sensor, T_base = (rigid(values[name]) for name in ("T_map_sensor", "T_map_base"))
        points = values["points"]
        own = {name: values[name] for name in ("dt", "variance", "pose_covariance")}
        m = emap.measure(points, T_sensor, T_base if base else None, **own)
        after = emap(before, m)
        return after, {n: getattr(after if n in LAYERS else after.statistics, n) for n in LAYERS + NUMBERS}

    return run, inputs


def slopes_of(total, given):
    """The gradient of a number by each input; zeros where it does not depend on one."""
    if not total.requires_grad:
        return {name: torch.zeros_like(value) for name, value in given.items()}
    gradients = torch.autograd.grad(total, list(given.values()), retain_graph=True, materialize_grads=True)
    return dict(zip(given, gradients, strict=True))


def rigid(top):
    return torch.cat([top, LAST_ROW.expand(*top.shape[:-2], 1, 4)], -2)


@pytest.mark.slow(4)
@pytest.mark.parametrize("head", HEADS)
@pytest.mark.parametrize("sensors, base", [(1, True), (2, True), (1, False)])
def test_finite_differences_of_every_layer_by_every_input(head, sensors, base):
    run, inputs = hollow_scene(HEADS[head], sensors, base)
    given = {name: value.clone().requires_grad_() for name, value in inputs.items()}
    after, outputs = run(given)
    assert (after.bounded & ~after.validity).sum() >= 6 and after.statistics.drift_correction != 0
    generator, moved = torch.Generator().manual_seed(0), set()
    weights = {n: 0.5 + torch.rand(v.shape, dtype=torch.float64, generator=generator) for n, v in outputs.items()}
    slopes = {name: slopes_of((output * weights[name]).sum(), given) for name, output in outputs.items()}
    for source, value in inputs.items():
        direction = torch.randn(value.shape, dtype=torch.float64, generator=generator) * value.abs()
        above, below = (run(inputs | {source: value + sign * STEP * direction})[1] for sign in (1, -1))
        for name, weight in weights.items():
            difference = ((above[name] - below[name]) * weight).sum().item() / (2 * STEP)
            slope = (slopes[name][source] * direction).sum().item()
            assert slope == pytest.approx(difference, rel=1e-5, abs=1e-7), f"{name} by {source}"
            moved |= {(name, source)} if abs(difference) > 1e-6 else set()
    for source in ("points", "T_map_sensor", "prior upper_bound"):
        assert ("upper_bound", source) in moved
    for name in ("elevation", "gradient_x", "gradient_y"):
        assert {(name, source) for source in ("points", "variance", "T_map_sensor", "prior elevation")} <= moved
    assert {("drift_error", "prior gradient_y"), ("variance", "pose_covariance")} <= moved


def test_the_upper_bound_follows_the_ray_that_bounds():
    """Lifting a ray's end by d lifts the bound by d times the cell's share of the way. Equal rays share it."""
    emap = small_map(1, (12, 1), 0.1, torch.float64)
    T = pose((-0.55, 0.05, 1.0))
    overhang = torch.tensor([[[1.57, 0.0, 0.5]] * 3], dtype=torch.float64)  # above the ramp, so it is believed
    points = overhang.requires_grad_()
    after = emap(emap.state, emap.measure(points, T, None, dt=0.1))
    bounded = (after.bounded & ~after.validity)[0, :, 0]
    assert bounded.any()
    cell = int(bounded.nonzero()[-1])
    (gradient,) = torch.autograd.grad(after.upper_bound[0, cell, 0], points)
    share = 0.1 * cell / 1.57
    assert gradient[..., 2].sum() == pytest.approx(share)
    torch.testing.assert_close(gradient[0, 1:], gradient[0, :-1])
