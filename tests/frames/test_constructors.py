"""Poses from positions and rotations as simulators give them."""

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from torchelev.frames import transform, transform_matrix, transform_xyzw

HALF = 0.5**0.5
CONSTRUCTORS = {
    transform: lambda rotation: np.roll(rotation.as_quat(), 1, -1),
    transform_xyzw: lambda rotation: rotation.as_quat(),
    transform_matrix: lambda rotation: rotation.as_matrix(),
}


def draw(seed, batch):
    """Positions (*batch, 3), far from the origin, and rotations in row-major order of the batch."""
    rng = np.random.default_rng(seed)
    return rng.normal(size=(*batch, 3)) * 1e5, Rotation.random(int(np.prod(batch)), rng)


@pytest.mark.parametrize("construct", CONSTRUCTORS)
@given(st.integers(0, 10_000), st.sampled_from([(), (3,), (2, 4)]))
def test_agrees_with_scipy(construct, seed, batch):
    position, rotations = draw(seed, batch)
    given_rotation = CONSTRUCTORS[construct](rotations)
    given_rotation = given_rotation.reshape(*batch, *given_rotation.shape[1:])
    for convert in (torch.from_numpy, np.asarray):
        T = construct(convert(position), convert(given_rotation))
        assert T.shape == (*batch, 4, 4) and T.dtype == torch.float64
        for index, R in zip(np.ndindex(*batch), rotations.as_matrix(), strict=True):
            np.testing.assert_allclose(T[index][:3, :3], R, atol=1e-12)
            np.testing.assert_array_equal(T[index][:3, 3], position[index])
            assert T[index][3].tolist() == [0, 0, 0, 1]


@pytest.mark.parametrize("construct, quat", [(transform, [HALF, 0, 0, HALF]), (transform_xyzw, [0, 0, HALF, HALF])])
def test_a_quarter_turn_about_z(construct, quat):
    T = construct(torch.tensor([1.0, 2.0, 3.0]), torch.tensor(quat))
    torch.testing.assert_close(T @ torch.tensor([1.0, 0, 0, 1]), torch.tensor([1.0, 3.0, 3.0, 1.0]))


def test_takes_the_nine_numbers_of_mujoco():
    position, rotations = draw(0, (4,))
    rows = rotations.as_matrix().reshape(4, 9)
    assert torch.equal(transform_matrix(position, rows), transform_matrix(position, rotations.as_matrix()))
    assert torch.equal(transform_matrix(position[0], rows[0]), transform_matrix(position, rows)[0])


def test_takes_numpy_and_lists():
    expected = transform(torch.tensor([[1.0, 2, 3]]).double(), torch.tensor([[HALF, 0, 0, HALF]], dtype=torch.float64))
    for give in (np.asarray, list):
        assert torch.equal(transform(give([[1, 2, 3]]), give([[HALF, 0, 0, HALF]])), expected)
    single = transform(np.ones(3, np.float32), np.array([1, 0, 0, 0], np.float32))
    assert single.dtype == torch.float32
    assert transform([0, 0, 1], [1, 0, 0, 0]).is_floating_point()
    with pytest.raises(ValueError, match="position: must be numbers"):
        transform(["a", "b", "c"], [1, 0, 0, 0])


def test_the_pose_shares_no_memory_with_arrays():
    position, rotation = np.zeros(3), np.eye(3)
    T = transform_matrix(position, rotation)
    position += 1
    rotation *= 2
    assert torch.equal(T, torch.eye(4, dtype=torch.float64))


def test_takes_views_and_read_only_arrays():
    position = np.array([3.0, 2, 1])[::-1]
    quat = np.broadcast_to(np.array([1.0, 0, 0, 0]), (1, 4))[0]
    assert transform(position, quat)[:3, 3].tolist() == [1, 2, 3]


def test_a_float64_position_keeps_its_precision_beside_a_float32_rotation():
    position = torch.tensor([123456.789012345, 0, 0], dtype=torch.float64)
    T = transform(position, torch.tensor([1.0, 0, 0, 0]))
    assert T.dtype == torch.float64 and T[0, 3] == position[0]


LEVEL = torch.tensor([1.0, 0, 0, 0])


@pytest.mark.parametrize("construct, name", [(transform, "quat_wxyz"), (transform_xyzw, "quat_xyzw")])
@pytest.mark.parametrize(
    "position, quat",
    [(3, 2 * LEVEL), (3, 0 * LEVEL), (3, LEVEL * torch.nan), (2, LEVEL), ((2, 3), LEVEL), (3, LEVEL[:3])],
)
def test_refuses_quaternions(construct, name, position, quat):
    with pytest.raises(ValueError, match=name):
        construct(torch.zeros(position), quat)


@pytest.mark.parametrize(
    "matrix", [-np.eye(3), 2 * np.eye(3), np.full((3, 3), np.nan), np.eye(4), np.ones(4), np.diag([1.0, 1, -1])]
)
def test_refuses_matrices(matrix):
    with pytest.raises(ValueError, match="rotation"):
        transform_matrix(np.zeros(3), matrix)


def test_only_the_wrong_matrix_of_a_batch_is_named():
    matrices = np.tile(np.eye(3), (3, 1, 1))
    matrices[1] *= 3
    with pytest.raises(ValueError, match=r"got \[\[\[3.0, 0.0, 0.0\]"):
        transform_matrix(np.zeros((3, 3)), matrices)


def test_reads_no_values_while_compiling():
    compiled = torch.compile(transform_matrix, backend="eager", fullgraph=True)
    assert torch.equal(compiled(torch.zeros(3), 2 * torch.eye(3))[:3, :3], 2 * torch.eye(3))


def test_gradients_reach_quaternions():
    quat = torch.tensor([1.0, 0, 0, 0], requires_grad=True)
    transform(torch.zeros(3), quat, upright=True)[1, 0].backward()  # 2 (x y + w z)
    assert quat.grad.tolist() == [0, 0, 0, 2]
