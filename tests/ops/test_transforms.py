"""Gradients by `torch.func`: reverse mode passes through the map; forward mode and `vmap` are refused by name."""

import pytest
import torch
from torch.autograd import forward_ad

from tests.helpers import small_map
from tests.test_gradients import CELLS, scene
from torchelev import LearnedTraversabilityConfig
from torchelev.ops.minima import polar_minimum

LAYERS = ("elevation", "variance", "upper_bound", "gradient_x", "traversability")


def core(traversability=None):
    """A number of each layer after a scan, as a function of points, sensor pose and elevation before."""
    emap, state, cloud, T = scene(unknown=(2, 2))
    if traversability is not None:
        emap = small_map(1, CELLS, dtype=torch.float64, traversability=traversability)

    def run(points, T_map_sensor, elevation):
        after = emap(state._replace(elevation=elevation), emap.measure(points, T_map_sensor, T, dt=0.1))
        return torch.stack([getattr(after, name).square().mean() for name in LAYERS])

    return run, (cloud, T, state.elevation.clone())


def ordinary_jacobian(run, inputs):
    given = [value.clone().requires_grad_() for value in inputs]
    rows = [torch.autograd.grad(number, given, retain_graph=True) for number in run(*given)]
    return [torch.stack(columns) for columns in zip(*rows, strict=True)]


@pytest.mark.slow(1)
@pytest.mark.parametrize("head", [None, LearnedTraversabilityConfig()])
def test_func_gradients_equal_ordinary_ones(head):
    run, inputs = core(head)
    expected = ordinary_jacobian(run, inputs)
    assert all((rows.abs() > 0).flatten(1).any(1)[0] for rows in expected)
    jacobian = torch.func.jacrev(run, argnums=(0, 1, 2))(*inputs)
    torch.testing.assert_close(list(jacobian), expected)
    gradient = torch.func.grad(lambda *given: run(*given).sum(), argnums=(0, 1, 2))(*inputs)
    torch.testing.assert_close(list(gradient), [rows.sum(0) for rows in expected])
    values, pull_back = torch.func.vjp(run, *inputs)
    torch.testing.assert_close(list(pull_back(torch.ones_like(values))), list(gradient))


def test_batched_gradients_of_an_ordinary_graph():
    run, inputs = core()
    points = inputs[0].clone().requires_grad_()
    numbers = run(points, *inputs[1:])
    (rows,) = torch.autograd.grad(numbers, points, torch.eye(len(LAYERS), dtype=torch.float64), is_grads_batched=True)
    torch.testing.assert_close(rows, ordinary_jacobian(run, inputs)[0])


def along(run, inputs, which):
    """Forward mode in the direction of one input."""
    with forward_ad.dual_level():
        given = [forward_ad.make_dual(v, torch.ones_like(v)) if k == which else v for k, v in enumerate(inputs)]
        return run(*given)


@pytest.mark.parametrize("which", range(3))
def test_forward_mode_is_refused(which):
    """It would leave out what passes a custom operator, without a word."""
    run, inputs = core()
    ones = tuple(torch.ones_like(value) for value in inputs)

    def by_one(value):
        return run(*[value if k == which else other for k, other in enumerate(inputs)])

    calls = [
        lambda: torch.func.jvp(run, inputs, ones),
        lambda: torch.func.jacfwd(by_one)(inputs[which]),
        lambda: torch.func.hessian(lambda value: by_one(value).sum())(inputs[which]),
        lambda: torch.func.grad(lambda v: torch.func.jvp(by_one, (v,), (ones[which],))[1].sum())(inputs[which]),
        lambda: along(run, inputs, which),
    ]
    for call in calls:
        with pytest.raises(NotImplementedError, match=r"jvp.* is not supported .*torch.func.grad, vjp or jacrev"):
            call()


@pytest.mark.parametrize("which", range(3))
def test_vmap_is_refused(which):
    run, inputs = core()
    batched = [torch.stack([v, v]) if k == which else v for k, v in enumerate(inputs)]
    dims = tuple(0 if k == which else None for k in range(3))
    gradient = torch.func.grad(lambda *given: run(*given).sum(), argnums=which)
    for function in (run, gradient):
        with pytest.raises(NotImplementedError, match=r"torch.func.vmap: is not supported .*num_envs"):
            torch.func.vmap(function, in_dims=dims)(*batched)


def test_dual_levels_without_tangents_do_no_harm():
    run, inputs = core()
    with forward_ad.dual_level():
        torch.testing.assert_close(run(*inputs), run(*inputs))


@pytest.mark.slow(1)
@pytest.mark.parametrize("seed", range(5))
def test_gradient_of_the_polar_minimum(seed):
    """Against finite differences, and equal values share it."""
    generator = torch.Generator().manual_seed(seed)
    index = torch.randint(0, 9 * 6, (2, 40), generator=generator)
    values = torch.rand(2, 40, dtype=torch.float64, generator=generator)

    def lowest(values):
        return polar_minimum(index, values, 6, [4, 2], 8, 9.0)

    assert torch.autograd.gradcheck(lowest, (values.clone().requires_grad_(),))
    equal = torch.full_like(values, 0.5).requires_grad_()
    (gradient,) = torch.autograd.grad(lowest(equal).sum(), equal)
    assert gradient.sum() == (lowest(equal) < 9).sum()
    assert (gradient >= 0).all()
