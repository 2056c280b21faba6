"""The paper's open filter."""

import math
import os

import numpy as np
import pytest
import torch
from hypothesis import given

from tests.filters.filter_cases import SEEDS, assert_batch_is_single, assert_gradients, assert_never_waits, random_layer
from torchelev.traversability.paper_filter import RIM, SHAPES, PaperFilter


def random_weights(seed=0):
    rng = np.random.default_rng(seed)
    return {name: rng.normal(0, 0.3, shape).astype(np.float32) for name, shape in SHAPES.items()}


@pytest.fixture
def net(tmp_path):
    np.savez(tmp_path / "weights.npz", **random_weights())
    return PaperFilter.from_npz(tmp_path / "weights.npz").double()


def by_loops(weights, z, i, j):
    """The filter at one cell of heights (H, W)."""
    total = 0.0
    for k in range(12):
        d, bank = k // 4 + 1, k % 4
        kernel = weights[f"conv{d}.weight"][bank, 0].astype(float)
        answer = sum(kernel[u + 1, v + 1] * z[i + d * u, j + d * v] for u in (-1, 0, 1) for v in (-1, 0, 1))
        total += float(weights["conv_final.weight"][0, k, 0, 0]) * abs(answer)
    return math.exp(-total)


@pytest.mark.skipif("PAPER_FILTER" not in os.environ, reason="PAPER_FILTER names no file of its weights and pairs")
def test_agrees_with_the_original():
    """Pairs of heights and ratings that the original made: in_0 (H, W) and out_0 (H - 6, W - 6), and so on."""
    path = os.environ["PAPER_FILTER"]
    original, net = np.load(path), PaperFilter.from_npz(path)
    numbers = [name[3:] for name in original.files if name.startswith("in_")]
    assert numbers
    for number in numbers:
        got = net(torch.from_numpy(original[f"in_{number}"])[None])[0, RIM:-RIM, RIM:-RIM].detach().numpy()
        np.testing.assert_allclose(got, original[f"out_{number}"], atol=1e-6, rtol=0)


def test_agrees_with_loops(net):
    z = np.random.default_rng(1).normal(0, 0.5, (2, 9, 8))
    got = net(torch.from_numpy(z)).detach().numpy()
    expected = np.zeros_like(z)
    for b, i, j in np.ndindex(2, 3, 2):
        expected[b, i + 3, j + 3] = by_loops(random_weights(), z[b], i + 3, j + 3)
    np.testing.assert_allclose(got, expected, atol=1e-12)


def test_by_hand():
    net = PaperFilter()
    with torch.no_grad():
        for bank in net.banks:
            bank.zero_()
        net.banks[1][2, 0, 0, 1], net.banks[1][2, 0, 1, 1] = -1.0, 1.0  # the height over the cell two before in x
        net.final.zero_()
        net.final[0, 6] = 10.0
    z = torch.zeros(1, 8, 7)
    z[0, 4] = 0.1
    expected = torch.zeros(8, 7)
    expected[3:5, 3] = torch.tensor([1.0, math.exp(-1)])
    torch.testing.assert_close(net(z)[0].detach(), expected)


@pytest.mark.parametrize("shape", [(1, 1, 1), (1, 6, 9), (2, 3, 40)])
def test_a_map_within_its_own_rim_is_not_rated(net, shape):
    layer = torch.ones(shape, dtype=torch.float64), torch.ones(shape, dtype=torch.bool)
    assert not net(layer[0]).any()
    assert not net.rate(layer)[1].any()


@given(SEEDS)
def test_unknown_cells_and_the_rim_are_not_rated(net, seed):
    values, known = random_layer(seed, (2, 12, 11), 0.98)
    rated, valid = net.rate((values, known))
    for b, i, j in np.ndindex(values.shape):
        inside = 3 <= i < 9 and 3 <= j < 8
        assert valid[b, i, j] == (inside and known[b, i - 3 : i + 4, j - 3 : j + 4].all())
        expected = by_loops(random_weights(), values[b].numpy(), i, j) if valid[b, i, j] else 0.0
        assert float(rated[b, i, j].detach()) == pytest.approx(expected, abs=1e-12)


def test_as_a_filter(net):
    layer = random_layer(0, (2, 9, 8), 0.99)
    assert_batch_is_single(net.rate, layer, atol=1e-12)
    assert_gradients(net.rate, layer)
    assert_never_waits(lambda layer: PaperFilter().rate(layer))


@pytest.mark.parametrize("name", list(SHAPES))
@pytest.mark.parametrize("fault", ["missing", "shape", "integers", "nan"])
def test_refuses_weights(tmp_path, name, fault):
    weights = random_weights()
    spoilt = {
        "shape": weights[name][..., None],
        "integers": weights[name].astype(int),
        "nan": weights[name] * np.nan,
    }
    rest = {k: v for k, v in weights.items() if k != name}
    np.savez(tmp_path / "w.npz", **rest, **({} if fault == "missing" else {name: spoilt[fault]}))
    with pytest.raises(ValueError, match=f"w.npz, {name}: must be"):
        PaperFilter.from_npz(tmp_path / "w.npz")


def test_refuses_files(tmp_path):
    with pytest.raises(FileNotFoundError, match="give an .npz with conv1.weight"):
        PaperFilter.from_npz(tmp_path / "none.npz")
    (tmp_path / "text.npz").write_text("no weights")
    np.save(tmp_path / "one.npy", np.zeros(3))
    for name in ("text.npz", "one.npy"):
        with pytest.raises(ValueError, match=f"{name}: must be a file of weights"):
            PaperFilter.from_npz(tmp_path / name)
