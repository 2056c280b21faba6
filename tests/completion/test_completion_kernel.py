"""The completion in C++ against the same with tensors."""

import subprocess
import sys

import pytest
import torch
from hypothesis import example, given
from hypothesis import strategies as st

from tests.completion.test_net import apply, random_layers, random_net
from torchelev.completion import completion_kernel
from torchelev.completion.complete import complete
from torchelev.kernels.cpu_build import find_compiler

pytestmark = pytest.mark.skipif(find_compiler() is None, reason="needs a C++ compiler")


def by_tensors(net, layers, resolution):
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("TORCHELEV_NATIVE", "0")
        return complete(net.weights, layers, resolution)


@given(
    seed=st.integers(0, 2**16),
    num_envs=st.integers(1, 3),
    H=st.integers(1, 40),
    W=st.integers(1, 40),
    known=st.sampled_from([0.0, 0.01, 0.1, 0.5, 1.0]),
    resolution=st.sampled_from([0.02, 0.05, 0.1]),
    threads=st.integers(1, 2),
    altitude=st.sampled_from([0.0, 2.0**14]),
    channels=st.sampled_from([(5, 7, 4), (8, 24, 8)]),
)
@example(0, 1, 40, 12, 0.5, 0.05, 1, 0.0, (5, 7, 4))  # cells of different rows whose columns are consecutive
def test_every_cell_equals_that_of_the_tensors(seed, num_envs, H, W, known, resolution, threads, altitude, channels):
    net, layers = random_net(seed, torch.float32, channels), random_layers(seed, num_envs, H, W, known, torch.float32)
    layers = layers._replace(elevation=layers.elevation + altitude, upper_bound=layers.upper_bound + altitude)
    expected = by_tensors(net, layers, resolution)
    torch.set_num_threads(threads)
    mean, std = completion_kernel.complete(net.weights, layers, resolution)
    torch.testing.assert_close(mean, expected.mean, rtol=0, atol=1e-5 + 2 * altitude * torch.finfo(torch.float32).eps)
    torch.testing.assert_close(std, expected.std, rtol=1e-4, atol=0.0)


def test_layers_may_be_views():
    """Of cells that lie apart in memory, as in a transposed map."""
    net, layers = random_net(1, torch.float32), random_layers(1, 2, 20, 30, dtype=torch.float32)
    turned = apply(lambda layer: layer.mT, layers)
    expected = completion_kernel.complete(net.weights, apply(lambda layer: layer.mT.contiguous(), layers), 0.05)
    for actual, same in zip(completion_kernel.complete(net.weights, turned, 0.05), expected, strict=True):
        assert torch.equal(actual, same)


def test_altitude_costs_no_precision_and_large_values_nothing():
    net, layers = random_net(2, torch.float32), random_layers(2, 1, 20, 20, dtype=torch.float32)
    low = completion_kernel.complete(net.weights, layers, 0.05)
    rise = 2.0**10
    high = completion_kernel.complete(
        net.weights,
        layers._replace(elevation=layers.elevation + rise, upper_bound=layers.upper_bound + rise),
        0.05,
    )
    torch.testing.assert_close(high[0] - rise, low[0], rtol=0, atol=1e-3)
    torch.testing.assert_close(high[1], low[1], rtol=0.05, atol=1e-3)
    lost = torch.full_like(layers.elevation, torch.nan)
    blank = layers._replace(upper_bound=torch.where(layers.bounded, layers.upper_bound, lost))
    for actual, same in zip(completion_kernel.complete(net.weights, blank, 0.05), low, strict=True):
        assert torch.equal(actual, same)


def test_what_is_not_of_float32_or_of_one_shape_is_left_to_the_tensors():
    double, single = random_net(), random_net(dtype=torch.float32)
    layers = random_layers(dtype=torch.float32)
    assert completion_kernel.complete(single.weights, layers, 0.05) is not None
    assert completion_kernel.complete(double.weights, random_layers(), 0.05) is None
    assert completion_kernel.complete(double.weights, layers, 0.05) is None
    assert completion_kernel.complete(single.weights, layers._replace(variance=layers.variance.double()), 0.05) is None
    assert completion_kernel.complete(single.weights, layers._replace(age=layers.age[:, :1, :1]), 0.05) is None


def test_forward_mode_and_vmap_are_refused():
    net, layers = random_net(dtype=torch.float32), random_layers(dtype=torch.float32)

    def mean(elevation):
        return net(*layers._replace(elevation=elevation), resolution=0.05).mean

    with pytest.raises(NotImplementedError, match="forward-mode"):
        torch.func.jvp(mean, (layers.elevation,), (torch.ones_like(layers.elevation),))
    with pytest.raises(NotImplementedError, match="vmap"):
        torch.func.vmap(mean)(layers.elevation[None])


FORK = """
import os
import torch
from torchelev import CompletionNet

torch.set_num_threads(2)
net, maps = CompletionNet().requires_grad_(False), torch.rand(2, 24, 24)
torch.rand(2**22).exp(), net(maps, maps > 0.5, resolution=0.04)
child = os.fork()
if child == 0:
    net(maps, maps > 0.5, resolution=0.04)
    os._exit(0)
assert os.waitpid(child, 0)[1] == 0
"""


@pytest.mark.slow(6)
def test_a_forked_process_does_not_wait_for_threads_that_it_lacks():
    subprocess.run([sys.executable, "-c", FORK], check=True, timeout=120)
