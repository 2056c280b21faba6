"""The attention encoder: against loops and torch's own attention, in any order of points, with unknown ones."""

import copy

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from tests.encoders.loops import loop_attention
from torchelev.encoders import AttentionConfig, MapAttention, MapLayout

B, S = 3, 5  # environments, entries of the state
SMALL = {"embed_dim": 12, "num_heads": 3, "hidden_channels": 4}
SCAN = [(0.1 * k, 0.03 * k * k) for k in range(8)]
GRID = [(0.1 * i, 0.2 * j) for i in range(4) for j in range(6)]


def make(shape, seed=0, **settings):
    cfg = AttentionConfig(**(SMALL | settings))
    torch.manual_seed(seed)
    return MapAttention(MapLayout.find("map", cfg, {"map": shape, "known": shape[-1:]}), cfg, S)


def draw(shape, seed=1):
    """Random states (B, S) and maps (B, *shape), the last channel a validity."""
    generator = torch.Generator().manual_seed(seed)
    state, values = (torch.randn(B, *one, generator=generator) for one in ((S,), shape))
    if len(shape) > 1:
        values[:, -1] = (values[:, -1] > 0).float()
    return state, values


@pytest.mark.parametrize(
    "shape, settings",
    [
        ((8,), {"points": SCAN}),
        ((2, 8), {"points": SCAN, "validity": 1}),
        ((2, 8), {"points": SCAN, "validity": 1, "mask_unknown": True}),
        ((24,), {"points": GRID, "grid": (4, 6), "kernel_size": 3}),
        ((2, 24), {"points": GRID, "grid": (4, 6), "kernel_size": 5, "validity": 1, "mask_unknown": True}),
        ((3, 4, 6), {"resolution": 0.1, "offset": (0.4, 0.0), "kernel_size": 3}),
        ((3, 4, 6), {"resolution": 0.1, "kernel_size": 3, "patch": 2, "validity": 2, "mask_unknown": True}),
        ((3, 4, 6), {"resolution": 0.1, "kernel_size": 1, "patch": 2}),
    ],
)
def test_equals_loops_over_heads_points_and_pixels(shape, settings):
    encoder, (state, values) = make(shape, **settings), draw(shape)
    encoding, weights = encoder(state, [values]), encoder.attention(state, [values])
    rows, columns = encoder.rows, encoder.columns
    coordinates = MapLayout.find("map", AttentionConfig(**settings), {"map": shape}).coordinates
    for b in range(B):
        image = values[b].double().numpy().reshape(-1, rows, columns)
        expected = loop_attention(encoder, state[b].double().numpy(), image, coordinates.double().numpy())
        np.testing.assert_allclose(encoding[b].detach().numpy(), expected[0], atol=1e-5)
        np.testing.assert_allclose(weights[b].detach().numpy(), expected[1], atol=1e-5)


def test_equals_torchs_attention():
    encoder, (state, values) = make((8,), points=SCAN), draw((8,))
    features, _ = encoder._describe([values])
    peer = torch.nn.MultiheadAttention(12, 3, batch_first=True)
    weights = {name: getattr(encoder, name).weight for name in ("query", "key", "value", "output")}
    zeros = torch.zeros(24)
    with torch.no_grad():
        peer.in_proj_weight.copy_(torch.eye(12).repeat(3, 1))
        peer.in_proj_weight[12:].copy_(torch.cat([weights["key"], weights["value"]]))
        peer.in_proj_bias.copy_(torch.cat([torch.zeros(12), zeros]))
        peer.out_proj.weight.copy_(weights["output"])
        peer.out_proj.bias.copy_(encoder.output.bias)
    points = features.transpose(1, 2)
    expected, attention = peer(encoder.query(state)[:, None], points, points, average_attn_weights=False)
    torch.testing.assert_close(encoder(state, [values]), expected[:, 0], atol=1e-5, rtol=0)
    torch.testing.assert_close(encoder.attention(state, [values]), attention[:, :, 0], atol=1e-5, rtol=0)


@given(st.integers(0, 2**16), st.integers(2, 40), st.booleans())
def test_the_order_of_points_does_not_matter(seed, num_points, mask):
    rng = np.random.default_rng(seed)
    points, order = rng.uniform(-1, 1, (num_points, 2)), rng.permutation(num_points)
    one = make((2, num_points), seed, points=points, validity=1, mask_unknown=mask)
    other = make((2, num_points), seed, points=points[order], validity=1, mask_unknown=mask)
    state, values = draw((2, num_points), seed)
    expected, weights = one(state, [values]), one.attention(state, [values])
    permuted = [values[..., order]]
    torch.testing.assert_close(other(state, permuted), expected, atol=1e-5, rtol=0)
    torch.testing.assert_close(other.attention(state, permuted), weights[..., order], atol=1e-5, rtol=0)
    moved = one(state, permuted)
    assert num_points < 3 or not torch.allclose(moved, expected, atol=1e-6), "values without their coordinates"


@given(st.integers(0, 2**16))
def test_unknown_points_get_no_attention_and_their_values_do_not_matter(seed):
    encoder, (state, values) = make((2, 8), seed, points=SCAN, validity=1, mask_unknown=True), draw((2, 8), seed)
    values[0, 1] = 0.0  # an environment that knows nothing
    values[1, 1, :2] = 1.0  # and one that knows something
    known = values[:, 1:].expand(-1, 3, -1) > 0
    weights = encoder.attention(state, [values])
    torch.testing.assert_close(weights.sum(-1), torch.ones(B, 3))
    assert not weights[1:][~known[1:]].any() and torch.equal(weights[0], torch.full((3, 8), 1 / 8))
    other = values.clone()
    other[:, 0] = torch.where(values[:, 1] > 0, values[:, 0], 7.0)
    assert torch.equal(encoder(state, [values])[1:], encoder(state, [other])[1:])


def test_validity_in_a_group_of_its_own_is_the_same():
    settings = {"points": SCAN, "mask_unknown": True}
    one, other = make((2, 8), **settings, validity=1), make((8,), **settings, validity="known")
    state, values = draw((2, 8))
    known = values[:, 1] > 0  # booleans count as well
    assert torch.equal(one(state, [values]), other(state, [values[:, 0], known]))


@pytest.mark.parametrize("mask", [False, True])
def test_gradients_reach_every_parameter(mask):
    encoder = make((3, 4, 6), resolution=0.1, kernel_size=3, patch=2, validity=2, mask_unknown=mask)
    state, values = draw((3, 4, 6))
    for tensor in (state, values):
        tensor.requires_grad_()
    encoder(state, [values]).square().sum().backward()
    named = {**dict(encoder.named_parameters()), "state": state, "values": values}
    assert not [name for name, value in named.items() if not value.grad.abs().max() > 1e-7]
    assert bool((encoder.key.weight.grad.abs().amax(-1) > 0).all())


def test_the_query_is_the_robots_state():
    encoder, (state, values) = make((8,), points=SCAN), draw((8,))
    same = values[:1].expand(B, -1)
    weights = encoder.attention(state, [same])
    assert (weights[0] - weights[1]).abs().max() > 1e-3
    first, second, *_ = encoder(state[:1].expand(B, -1), [same])
    torch.testing.assert_close(first, second)  # matrix products may round by row


def test_weights_of_other_points_are_not_loaded():
    encoder, same, moved = make((8,), points=SCAN), make((8,), 1, points=SCAN), make((8,), points=SCAN[::-1])
    same.load_state_dict(copy.deepcopy(encoder.state_dict()))
    state, values = draw((8,))
    assert torch.equal(same(state, [values]), encoder(state, [values]))
    with pytest.raises(RuntimeError, match="coordinates: must be those of this model, got others"):
        moved.load_state_dict(encoder.state_dict())


def test_an_embedding_without_room_for_the_features_is_refused():
    with pytest.raises(ValueError, match="embed_dim: must exceed the 3 coordinates and values of a point, got 3"):
        make((8,), points=SCAN, embed_dim=3, num_heads=1)


def test_stays_on_its_device_and_in_its_precision():
    encoder = make((2, 8), points=SCAN, validity=1, mask_unknown=True).to("meta")
    assert encoder(torch.zeros(B, S, device="meta"), [torch.zeros(B, 2, 8, device="meta")]).device.type == "meta"
    double = make((8,), points=SCAN).double()
    assert double(torch.zeros(B, S).double(), [torch.zeros(B, 8)]).dtype == torch.float64
