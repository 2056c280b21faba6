"""Poses from what simulators give."""

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from torchelev.frames import transform


@given(st.integers(0, 10_000), st.sampled_from([(), (3,), (2, 4)]))
def test_agrees_with_scipy(seed, batch):
    rng = np.random.default_rng(seed)
    quat = rng.normal(size=(*batch, 4))
    quat /= np.linalg.norm(quat, axis=-1, keepdims=True)
    position = rng.normal(size=(*batch, 3)) * 1e5
    T = transform(torch.from_numpy(position), torch.from_numpy(quat))
    assert T.shape == (*batch, 4, 4) and T.dtype == torch.float64
    for index in np.ndindex(*batch):
        w, x, y, z = quat[index]
        np.testing.assert_allclose(T[index][:3, :3], Rotation.from_quat([x, y, z, w]).as_matrix(), atol=1e-12)
        np.testing.assert_array_equal(T[index][:3, 3], position[index])
        assert T[index][3].tolist() == [0, 0, 0, 1]


def test_a_quarter_turn_about_z():
    half = 0.5**0.5
    T = transform(torch.tensor([1.0, 2.0, 3.0]), torch.tensor([half, 0.0, 0.0, half]))
    torch.testing.assert_close(T @ torch.tensor([1.0, 0, 0, 1]), torch.tensor([1.0, 3.0, 3.0, 1.0]))


@pytest.mark.parametrize(
    "position, quat, named",
    [
        (torch.zeros(3), torch.tensor([2.0, 0, 0, 0]), "quat_wxyz"),
        (torch.zeros(3), torch.zeros(4), "quat_wxyz"),
        (torch.zeros(2), torch.tensor([1.0, 0, 0, 0]), "position"),
        (torch.zeros(2, 3), torch.tensor([1.0, 0, 0, 0]), "quat_wxyz"),
    ],
)
def test_refuses(position, quat, named):
    with pytest.raises(ValueError, match=named):
        transform(position, quat)


def test_takes_numpy_and_lists():
    half = 0.5**0.5
    expected = transform(torch.tensor([[1.0, 2, 3]]).double(), torch.tensor([[half, 0, 0, half]], dtype=torch.float64))
    for give in (np.asarray, list):
        assert torch.equal(transform(give([[1, 2, 3]]), give([[half, 0, 0, half]])), expected)
    single = transform(np.ones(3, np.float32), np.array([1, 0, 0, 0], np.float32))
    assert single.dtype == torch.float32
    assert transform([0, 0, 1], [1, 0, 0, 0]).is_floating_point()
    with pytest.raises(ValueError, match="position: must be numbers"):
        transform(["a", "b", "c"], [1, 0, 0, 0])


def test_refuses_nan():
    with pytest.raises(ValueError, match="quat_wxyz"):
        transform(torch.zeros(3), torch.full((4,), torch.nan))
