"""The completion network: its equations against slow ones, what it promises, and what it refuses."""

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from tests import reference
from torchelev.completion.complete import CompletionInput, complete
from torchelev.completion.net import VERSION, CompletionNet
from torchelev.completion.surroundings import DIRECTIONS, NONE, count_steps
from torchelev.files.weight_files import write_weights

RESOLUTION = 0.08


def random_net(seed=0, dtype=torch.float64, channels=(5, 7, 4)):
    """A network whose weights are all drawn at random, biases included."""
    torch.manual_seed(seed)
    net = CompletionNet(*channels)
    for value in net.parameters():
        torch.nn.init.normal_(value, std=0.4)
    return net.to(dtype).requires_grad_(False)


def random_layers(seed=0, num_envs=2, H=14, W=11, known=0.2, dtype=torch.float64):
    """Layers of rough ground with holes, bounds above some of them."""
    g = torch.Generator().manual_seed(seed)

    def draw():
        return torch.rand(num_envs, H, W, generator=g, dtype=dtype)

    elevation, validity = 0.3 * draw(), draw() < known
    age, variance = 20 * draw(), 1e-3 * draw() + 1e-5
    return CompletionInput(elevation, validity, variance, elevation + 0.3 * draw(), draw() < 0.5, age)


def run(net, layers, resolution=RESOLUTION):
    return net(*layers, resolution=resolution)


def apply(function, layers):
    return CompletionInput(*(function(layer) for layer in layers))


def test_steps_lead_to_the_next_known_cell():
    known = random_layers(1, 1).validity
    steps = count_steps(known)
    for k, direction in enumerate(DIRECTIONS):
        for i, j in np.ndindex(*known.shape[1:]):
            expected = reference.next_known(known[0].numpy(), i, j, direction)
            assert int(steps[k, 0, i, j]) == (NONE if expected is None else expected)


@pytest.mark.slow(2)
@pytest.mark.parametrize("known", [0.0, 0.02, 0.15, 0.7])
@pytest.mark.parametrize(("resolution", "size"), [(0.02, (14, 11)), (0.08, (14, 11)), (0.1, (3, 40)), (0.1, (40, 3))])
def test_every_cell_follows_the_slow_equations(known, resolution, size):
    net, layers = random_net(), random_layers(3, 1, *size, known=known)
    answer = run(net, layers, resolution)
    w = {name: value.numpy() for name, value in net.state_dict().items()}
    elevation, valid, variance, bound, bounded, age = (layer[0].numpy() for layer in layers)
    for i, j in np.ndindex(*valid.shape):
        hidden = bounded & ~valid
        if valid[i, j]:
            expected = reference.refine_cell(w, elevation, valid, variance, hidden, age, i, j, resolution)
        else:
            expected = reference.complete_cell(w, elevation, valid, bound, hidden, i, j, resolution)
        actual = float(answer.mean[0, i, j]), float(answer.std[0, i, j])
        assert actual == pytest.approx(expected, abs=1e-9), (i, j, valid[i, j])


def test_a_batch_equals_single_maps():
    net, layers = random_net(), random_layers(4, 3)
    together = run(net, layers)
    for b in range(3):
        alone = run(net, apply(lambda layer, b=b: layer[b : b + 1], layers))
        torch.testing.assert_close(together.mean[b : b + 1], alone.mean)
        torch.testing.assert_close(together.std[b : b + 1], alone.std)


def test_all_cells_at_once_equal_the_unknown_ones_alone():
    """With gradients, and on a GPU, every cell is predicted; on a CPU, only those that are unknown."""
    net, layers = random_net(), random_layers(5)
    alone = run(net, layers)
    net.requires_grad_(True)
    together = run(net, layers)
    assert together.mean.requires_grad
    torch.testing.assert_close(together.mean.detach(), alone.mean)
    torch.testing.assert_close(together.std.detach(), alone.std)


SYMMETRIES = {
    "quarter turn": lambda layer: torch.rot90(layer, 1, (1, 2)),
    "half turn": lambda layer: torch.rot90(layer, 2, (1, 2)),
    "mirror x": lambda layer: layer.flip(1),
    "mirror y": lambda layer: layer.flip(2),
    "transpose": lambda layer: layer.transpose(1, 2),
}


@pytest.mark.parametrize("name", SYMMETRIES)
def test_turns_and_mirrors_commute(name):
    net, layers, turn = random_net(dtype=torch.float32), random_layers(6, dtype=torch.float32), SYMMETRIES[name]
    expected, actual = run(net, layers), run(net, apply(turn, layers))
    torch.testing.assert_close(actual.mean, turn(expected.mean), atol=1e-5, rtol=0)
    torch.testing.assert_close(actual.std, turn(expected.std), atol=1e-5, rtol=1e-5)


@settings(max_examples=10, deadline=None)
@given(i=st.integers(0, 5), j=st.integers(0, 5), seed=st.integers(0, 99))
def test_whole_cell_shifts_commute(i, j, seed):
    """A map in a wider window, whose rest is unknown, reads the same wherever it lies."""
    net, layers = random_net(dtype=torch.float32), random_layers(seed, 1, dtype=torch.float32)
    pad = [torch.nn.functional.pad] * 2
    placed = [
        apply(lambda layer, f=f, at=at: f(layer.float(), at).to(layer.dtype), layers)
        for f, at in zip(pad, ((2, 4, 2, 4), (2 + j - 2, 6 - j, i, 6 - i)), strict=True)
    ]
    answers = [run(net, each) for each in placed]
    H, W = layers.elevation.shape[1:]
    first = answers[0].mean[:, 2 : 2 + H, 2 : 2 + W], answers[0].std[:, 2 : 2 + H, 2 : 2 + W]
    second = answers[1].mean[:, i : i + H, j : j + W], answers[1].std[:, i : i + H, j : j + W]
    for a, b in zip(first, second, strict=True):
        torch.testing.assert_close(a, b, atol=1e-5, rtol=1e-5)


@pytest.mark.parametrize("altitude", [-50.0, 4.0, 1000.0])
def test_altitude_shifts_the_mean_alone(altitude):
    net, layers = random_net(), random_layers(7)
    high = layers._replace(elevation=layers.elevation + altitude, upper_bound=layers.upper_bound + altitude)
    expected, actual = run(net, layers), run(net, high)
    torch.testing.assert_close(actual.mean - altitude, expected.mean, atol=1e-5, rtol=0)
    torch.testing.assert_close(actual.std, expected.std, atol=1e-5, rtol=0)


def test_measured_cells_stay_within_two_standard_deviations():
    for seed in range(5):
        net, layers = random_net(seed), random_layers(seed, known=0.8)
        far = (run(net, layers).mean - layers.elevation).abs() / layers.variance.clamp(min=1e-6).sqrt()
        assert float(far[layers.validity].max()) <= 2.0 + 1e-9


def test_unknown_cells_do_not_rise_above_their_bound():
    for seed in range(5):
        net, layers = random_net(seed), random_layers(seed)
        layers = layers._replace(upper_bound=layers.upper_bound - 0.3)
        is_bounded = layers.bounded & ~layers.validity
        over = (run(net, layers).mean - layers.upper_bound)[is_bounded]
        assert float(over.max()) <= 1e-9
        assert float(over.max()) > -1e-6  # the bound does hold some down


def test_the_bound_holds_where_no_direction_leads_to_known_ground():
    zero = torch.zeros(1, 40, 40, dtype=torch.float64)
    known = zero == 1
    known[:, 20, 20] = True
    layers = CompletionInput(zero, known, zero, zero - 0.5, ~known, zero)
    assert float(run(random_net(), layers).mean[~known].max()) <= -0.5
    nothing = layers._replace(validity=known & False)
    assert float(run(random_net(), nothing).mean[~known].max()) == -0.5


def test_to_see_the_same_ground_again_makes_no_unknown_cell_surer():
    net, layers = random_net(), random_layers(8)
    again = layers._replace(variance=layers.variance / 10, age=torch.zeros_like(layers.age))
    first, second = run(net, layers), run(net, again)
    unknown = ~layers.validity
    assert torch.equal(first.std[unknown], second.std[unknown])
    assert torch.equal(first.mean[unknown], second.mean[unknown])
    assert not torch.equal(first.std[layers.validity], second.std[layers.validity])


def test_far_from_measurements_the_prior_counts():
    net = random_net()
    layers = random_layers(9, 1, H=400, W=5)
    near = torch.zeros_like(layers.validity)
    near[:, :3] = True
    std = run(net, layers._replace(validity=near, bounded=near & False), 0.1).std[0, :, 2]
    logs = (std.log() - net.prior).abs()
    assert float(logs[-1]) < 0.02 * float(logs[5])  # at 40 m, of 0.3 m


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_a_map_of_which_nothing_is_known_reads_zero_with_the_prior(dtype):
    net, layers = random_net(dtype=dtype), random_layers(dtype=dtype, known=0.0)
    answer = run(net, layers)
    assert torch.equal(answer.mean, torch.zeros_like(answer.mean))
    torch.testing.assert_close(answer.std, net.prior.exp().expand_as(answer.std))


def test_what_does_not_count_has_no_effect():
    net, layers = random_net(), random_layers(10)
    unknown, unbounded = ~layers.validity, ~(layers.bounded & ~layers.validity)
    spoilt = layers._replace(
        elevation=layers.elevation.masked_fill(unknown, 1e6),
        variance=layers.variance.masked_fill(unknown, -1.0),
        upper_bound=layers.upper_bound.masked_fill(unbounded, -1e6),
        age=layers.age.masked_fill(unknown, 1e9),
    )
    for a, b in zip(run(net, layers), run(net, spoilt), strict=True):
        assert torch.equal(a, b)


def test_heights_that_are_not_finite_count_as_unknown():
    net, layers = random_net(), random_layers(11)
    i, j = (int(n) for n in layers.validity[0].nonzero()[0])
    bad = layers.elevation.clone()
    bad[0, i, j] = torch.nan
    validity = layers.validity.clone()
    validity[0, i, j] = False
    expected = run(net, layers._replace(validity=validity))
    for a, b in zip(run(net, layers._replace(elevation=bad)), expected, strict=True):
        assert torch.equal(a, b)


@pytest.mark.parametrize("name", ["variance", "age", "upper_bound"])
@pytest.mark.parametrize("bad", [torch.nan, torch.inf])
def test_other_layers_that_are_not_finite_do_not_count(name, bad):
    net, layers = random_net(), random_layers(14)
    spoilt = layers._replace(**{name: torch.full_like(layers.elevation, bad)})
    missing = {"upper_bound": {"bounded": layers.bounded & False}}.get(name, {"validity": layers.validity & False})
    for a, b in zip(run(net, spoilt), run(net, layers._replace(**missing)), strict=True):
        assert bool(a.isfinite().all()) and torch.equal(a, b)


def test_a_map_may_be_wider_than_16_bits_count():
    net = random_net(dtype=torch.float32)
    layers = random_layers(16, 1, H=40_000, W=1, known=0.0, dtype=torch.float32)
    layers.validity[0, -1] = True
    layers.elevation[0, -1] = 2.0
    mean = run(net, layers._replace(bounded=layers.bounded & False)).mean
    assert 1.9 < float(mean[0, 0]) < 2.1


def test_level_ground_has_a_gradient():
    """Heights that are exactly equal are where a logarithm of their difference is easily given none."""
    net, zero = random_net(), torch.zeros(1, 9, 9, dtype=torch.float64, requires_grad=True)
    known = torch.ones(1, 9, 9, dtype=torch.bool)
    known[0, 4, 4] = False
    blank = torch.zeros(1, 9, 9, dtype=torch.float64)
    answer = net(zero, known, blank, blank, known & False, blank, resolution=RESOLUTION)
    (gradient,) = torch.autograd.grad(answer.std[0, 4, 4], zero)
    assert bool(gradient.isfinite().all()) and float(gradient.abs().max()) > 0


def test_what_is_unknown_spoils_no_gradient():
    net, layers = random_net(), random_layers(17)
    net.requires_grad_(True)
    unknown = ~layers.validity
    spoilt = {name: getattr(layers, name).masked_fill(unknown, torch.nan) for name in ("elevation", "variance", "age")}
    mean, std = run(net, layers._replace(**spoilt))
    (mean.sum() + std.sum()).backward()
    assert all(bool(value.grad.isfinite().all()) for value in net.parameters() if value.grad is not None)


@pytest.mark.parametrize("size", [(1, 1), (1, 7), (6, 1)])
@pytest.mark.parametrize("known", [0.0, 0.5, 1.1])
def test_maps_of_any_size(size, known):
    layers = random_layers(18, 2, *size, known=known)
    assert all(bool(layer.isfinite().all()) and layer.shape == (2, *size) for layer in run(random_net(), layers))


@pytest.mark.slow(1)
def test_gradients_with_respect_to_elevation_and_weights():
    net, layers = random_net(), random_layers(12, 1, H=5, W=4, known=0.4)
    net.requires_grad_(True)
    free = layers.elevation.clone().requires_grad_(True)

    def answer(elevation, *weights):
        return complete(type(net.weights)(*weights), layers._replace(elevation=elevation), RESOLUTION)

    torch.autograd.gradcheck(answer, (free, *net.weights), atol=1e-5, fast_mode=True)


def test_weights_survive_a_file(tmp_path):
    net, layers = random_net(dtype=torch.float32), random_layers(13, dtype=torch.float32)
    net.save(tmp_path / "net.pt")
    loaded = CompletionNet.from_pretrained(tmp_path / "net.pt").requires_grad_(False)
    for a, b in zip(run(net, layers), run(loaded, layers), strict=True):
        assert torch.equal(a, b)


def test_weights_of_another_version_are_refused(tmp_path):
    net = CompletionNet()
    write_weights(tmp_path / "net.pt", VERSION + 1, net.config, net.state_dict())
    with pytest.raises(ValueError, match=rf"must be of version {VERSION}, got {VERSION + 1}"):
        CompletionNet.from_pretrained(tmp_path / "net.pt")
    write_weights(tmp_path / "net.pt", VERSION, {"channels": 3}, net.state_dict())
    with pytest.raises(ValueError, match=r"net.pt: must be a file of weights"):
        CompletionNet.from_pretrained(tmp_path / "net.pt")
    with pytest.raises(FileNotFoundError, match=r"python -m training.completion"):
        CompletionNet.from_pretrained(tmp_path / "none.pt")


def test_the_shipped_weights_are_few_and_finite():
    net = CompletionNet.from_pretrained()
    assert sum(value.numel() for value in net.parameters()) <= 300_000
    answer = run(net, random_layers(dtype=torch.float32))
    assert all(bool(layer.isfinite().all()) for layer in answer)


@pytest.mark.parametrize(
    ("change", "error", "text"),
    [
        ({"resolution": 0.01}, ValueError, "resolution: must be 0.02 to 0.1 m, got 0.01"),
        ({"elevation": torch.zeros(2, 3)}, ValueError, r"elevation: must be \(B, H, W\), not empty"),
        ({"elevation": torch.zeros(1, 4, 4).half()}, TypeError, "elevation: must be torch.float32, got torch.float16"),
        ({"validity": torch.zeros(1, 4, 4)}, TypeError, "validity: must be torch.bool"),
        ({"variance": torch.zeros(1, 4, 5)}, ValueError, r"variance: must be \(1, 4, 4\)"),
        ({"upper_bound": torch.zeros(1, 4, 4)}, ValueError, "upper_bound, bounded: must come together"),
        ({"elevation": None}, TypeError, "elevation: must be a tensor"),
        ({"elevation": torch.zeros(0, 4, 4)}, ValueError, r"elevation: must be \(B, H, W\), not empty"),
        ({"variance": 0.1}, TypeError, "variance: must be a tensor, got float"),
    ],
)
def test_bad_input_is_refused(change, error, text):
    good = {"elevation": torch.zeros(1, 4, 4), "validity": torch.ones(1, 4, 4, dtype=torch.bool), "resolution": 0.05}
    net = CompletionNet()
    net(**good)
    with pytest.raises(error, match=text):
        net(**(good | change))


def test_half_precision_is_refused():
    layers = random_layers(dtype=torch.float32)
    half = CompletionInput(*(layer.half() if layer.is_floating_point() else layer for layer in layers))
    with pytest.raises(TypeError, match="weights: must be of float32 or float64, got torch.float16"):
        run(CompletionNet().half(), half)


def test_gradients_have_gradients_also_by_functions():
    net, layers = random_net(0), random_layers(0, 1)

    def total(elevation):
        return net(*layers._replace(elevation=elevation), resolution=0.05).mean.square().sum()

    x = layers.elevation.clone().requires_grad_()
    (first,) = torch.autograd.grad(total(x), x, create_graph=True)
    (expected,) = torch.autograd.grad(first.square().sum(), x)
    found = torch.func.grad(lambda y: torch.func.grad(total)(y).square().sum())(layers.elevation)
    torch.testing.assert_close(found, expected)
