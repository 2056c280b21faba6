"""Paths: by hand, against footprints one by one, and what is refused."""

import math

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from tests.devices import NoConstants, OneDevice, unread
from tests.helpers import pose
from tests.planning.maps import ground_map, random_map, rectangle
from torchelev import ElevationMap
from torchelev.planning.footprint import FootprintConfig, check_footprint
from torchelev.planning.path_check import check_path
from torchelev.planning.planner import plan
from torchelev.planning.standing import place_footprint

SEEDS = st.integers(0, 10_000)
FOOTPRINT = torch.tensor([[0.25, 0.125], [-0.25, 0.125], [-0.25, -0.125], [0.25, -0.125]]).double()
NOWHERE = torch.full((2, 3, 2), math.nan)  # where no robot stands


def path(*poses):
    return torch.tensor([poses], dtype=torch.float64)


def blocked(*cells):
    """Ground that carries the robot everywhere but on these cells."""
    emap = ground_map(1.0)
    for i, j in cells:
        emap.traversability[0, i, j] = 0.0
    return emap


def random_path(rng, emap, number=4):
    steps = np.concatenate(
        [rng.uniform(-0.25, 0.25, (emap.num_envs, number, 2)), rng.uniform(-1, 1, (emap.num_envs, number, 1))], -1
    )
    start = np.concatenate([emap.center[:, None, :2].numpy(), rng.uniform(-9, 9, (emap.num_envs, 1, 1))], -1)
    return torch.from_numpy(start + np.cumsum(steps, 1))


# By hand --------------------------------------------------------------------------------------------------------------


def test_a_path_by_hand():
    """From x = -0.5 to 0 and 0.5, in steps of a cell; the cell with x from 0.375 to 0.5 is unsafe.

    The footprint's front reaches it from x = 0.1875 on (its centre): at sample 6, on the way to pose 2.
    """
    emap = blocked((11, 7))
    check = check_path(emap, path((-0.5, 0, 0), (0, 0, 0), (0.5, 0, 0)), FOOTPRINT, samples=4)
    assert check.poses[0, :, 0].tolist() == [-0.5, -0.375, -0.25, -0.125, 0, 0.125, 0.25, 0.375, 0.5]
    assert check.footprints.safe.tolist() == [[True] * 6 + [False] * 3]
    assert check.footprints.unsafe[0].tolist() == [0.0] * 6 + [0.125] * 3
    assert check.safe.tolist() == [False] and check.first_unsafe.tolist() == [2]
    check = check_path(emap, path((-0.5, 0, 0), (0, 0, 0)), FOOTPRINT, samples=4)
    assert check.safe.tolist() == [True] and check.first_unsafe.tolist() == [2], "the number of poses"


def test_what_lies_between_poses_is_not_stepped_over():
    """The unsafe cell is below no pose, and well before the second."""
    emap = blocked((8, 7))
    poses = path((-0.5, 0, 0), (0.7, 0, 0), (0.7, 0.1, 0))
    assert check_footprint(emap, torch.cat([rectangle(-0.5), rectangle(0.7)], 1)).safe.all()
    check = check_path(emap, poses, FOOTPRINT, samples=10)
    assert not check.safe.any() and check.first_unsafe.tolist() == [1]
    assert check.footprints.safe[0, ::10].all(), "at the poses themselves nothing is wrong"


def test_the_first_pose_counts():
    check = check_path(blocked((4, 7)), path((-0.5, 0, 0), (0.0, 0, 0)), FOOTPRINT)
    assert check.first_unsafe.tolist() == [0] and not check.safe.any()
    for there, number in ((-0.5, 0), (0.5, 1)):
        alone = check_path(blocked((4, 7)), path((there, 0, 0)), FOOTPRINT)
        assert alone.first_unsafe.tolist() == [number] and alone.safe.tolist() == [number == 1]
        assert alone.poses.shape == (1, 1, 3)


def test_robots_turn_the_shorter_way():
    check = check_path(ground_map(), path((0, 0, 3.0), (0, 0, -3.0), (0, 0, 3.0)), FOOTPRINT, samples=2)
    yaw = check.poses[0, :, 2]
    assert yaw.tolist() == pytest.approx([3.0, math.pi, -3.0, -math.pi, 3.0])
    check = check_path(ground_map(), path((0, 0, 0.5), (0, 0, 0.5 + 40 * math.pi)), FOOTPRINT, samples=1)
    assert check.safe.all(), "whole turns are none"


def test_a_turned_footprint_lies_where_it_should():
    """Looking along +y, its front covers y up to 0.25, and x from -0.125 to 0.125."""
    lopsided = torch.tensor([[0.25, 0.125], [0.0, 0.125], [0.0, -0.125], [0.25, -0.125]]).double()
    for yaw, cells in ((0.0, (9, 7)), (math.pi / 2, (8, 8)), (math.pi, (6, 7)), (-math.pi / 2, (8, 5))):
        for cell in ((9, 7), (8, 8), (6, 7), (8, 5)):
            check = check_path(blocked(cell), path((0.0, 0.0, yaw)), lopsided)
            assert check.safe.tolist() == [cell != cells]


# Why not --------------------------------------------------------------------------------------------------------------


def test_an_empty_path_is_not_safe():
    """No path leads through the first map's wall. No threshold and no assumed ground makes it safe."""
    emap = ground_map(1.0, num_envs=2)
    emap.traversability[0, 10] = 0.0
    here = emap.center[:, :2].double()
    found = plan(emap, here, here + torch.tensor([0.6, 0.0]))
    assert found.reached.tolist() == [False, True] and found.poses()[0].isnan().all()
    check = check_path(emap, found.poses(), FOOTPRINT)
    assert check.safe.tolist() == [False, True] and check.first_unsafe.tolist() == [0, found.xy.shape[1]]
    assert check.poses[0].isnan().all() and check.footprints.unknown[0].eq(1).all()
    assert check.explain() == [
        "the path is empty: no path was found; Path.explain() says why",
        "every footprint along the path is safe",
    ]
    here = place_footprint(emap, FOOTPRINT, torch.cat([here, torch.zeros(2, 1)], 1)[:, None])[:, 0]
    lenient = FootprintConfig(min_traversability=0.0, max_unsafe=1.0, max_unknown=1.0)
    assert check_path(emap, found.poses(), FOOTPRINT, lenient, standing=here).safe.tolist() == [False, True]


def test_a_path_that_is_not_safe_says_where():
    check = check_path(blocked((11, 7)), path((-0.5, 0, 0), (0, 0, 0), (0.5, 0, 0)), FOOTPRINT, samples=4)
    assert check.explain() == [
        "pose 2 cannot be reached safely: at x = 0.25 m, y = 0.00 m mean traversability 0.88, "
        "12% of the cells unsafe, 0% unknown"
    ]


# Properties -----------------------------------------------------------------------------------------------------------


@pytest.mark.slow(2)
@given(SEEDS, st.integers(3, 9))
def test_each_place_is_a_footprint(seed, samples):
    rng = np.random.default_rng(seed)
    emap = random_map(seed, known=0.95)
    poses = random_path(rng, emap)
    cfg = FootprintConfig(min_traversability=0.4, max_unsafe=0.4, max_unknown=0.2)
    check = check_path(emap, poses, FOOTPRINT, cfg, samples=samples + 3, standing=NOWHERE)
    torch.testing.assert_close(check.poses[:, :: samples + 3], poses, rtol=0, atol=1e-12)
    number = check.poses.shape[1]
    for b in range(2):
        for m in range(number):
            x, y, yaw = check.poses[b, m].tolist()
            single = check_footprint(emap, rectangle(x, y, 0.5, 0.25, yaw).repeat(2, 1, 1, 1), cfg)
            for values, alone in zip(check.footprints, single, strict=True):
                assert values[b, m].item() == pytest.approx(alone[b, 0].item())
        bad = [math.ceil(m / (samples + 3)) for m in range(number) if not check.footprints.safe[b, m]]
        assert check.safe[b].item() == (not bad) and check.first_unsafe[b].item() == min(bad, default=4)


@given(SEEDS)
def test_matrices_and_xy_yaw_agree(seed):
    """The tilt of the base does not matter, its heading does."""
    rng = np.random.default_rng(seed)
    emap = random_map(seed, 1, known=0.95)
    poses = random_path(rng, emap, 3)
    matrices = torch.cat([pose((x, y, 0.6), yaw, *rng.uniform(-0.4, 0.4, 2)) for x, y, yaw in poses[0].tolist()])[None]
    flat, full = (check_path(emap, given, FOOTPRINT, samples=9) for given in (poses, matrices))
    torch.testing.assert_close(flat.poses[..., :2], full.poses[..., :2])
    torch.testing.assert_close(flat.poses[..., 2].cos(), full.poses[..., 2].cos())
    torch.testing.assert_close(flat.poses[..., 2].sin(), full.poses[..., 2].sin())
    torch.testing.assert_close(flat.footprints.traversability, full.footprints.traversability)


@given(SEEDS)
def test_no_vertex_moves_farther_than_a_cell(seed):
    """With the number of samples that the error asks for."""
    rng = np.random.default_rng(seed)
    emap = random_map(seed)
    poses = random_path(rng, emap)
    with pytest.raises(ValueError, match="raise samples to") as error:
        check_path(emap, poses, FOOTPRINT, samples=1)
    samples = int(str(error.value).split("raise samples to ")[1].split(",")[0])
    places = check_path(emap, poses, FOOTPRINT, samples=samples).poses
    turn = torch.stack([places[..., 2].cos(), -places[..., 2].sin(), places[..., 2].sin(), places[..., 2].cos()], -1)
    corners = places[..., None, :2] + FOOTPRINT @ turn.unflatten(-1, (2, 2)).mT
    steps = (corners[:, 1:] - corners[:, :-1]).norm(dim=-1)
    assert steps.max() <= 0.125 * 1.001
    with pytest.raises(ValueError, match="from sample to sample"):
        check_path(emap, poses, FOOTPRINT, samples=samples - 1)


def test_batches_equal_single_paths():
    emap, rng = random_map(0), np.random.default_rng(0)
    poses = random_path(rng, emap)
    both = check_path(emap, poses, FOOTPRINT, samples=9)
    single = random_map(0, 1)
    for b in range(2):
        for name, value in emap.state._asdict().items():
            if name != "statistics":
                getattr(single, name).copy_(value[b : b + 1])
        alone = check_path(single, poses[b : b + 1], FOOTPRINT, samples=9)
        assert torch.equal(alone.poses[0], both.poses[b]) and alone.first_unsafe[0] == both.first_unsafe[b]
        assert all(torch.equal(a[0], c[b]) for a, c in zip(alone.footprints, both.footprints, strict=True))
    other = random_map(1)
    swapped = check_path(emap, poses, FOOTPRINT, samples=9, state=other.state).footprints
    assert torch.equal(swapped.traversability, check_path(other, poses, FOOTPRINT, samples=9).footprints.traversability)


# Devices, and what is refused -----------------------------------------------------------------------------------------


@pytest.mark.slow(1)
def test_checks_do_not_read_values():
    """Tensors on "meta" have no values, so that reading one raises."""
    emap = ElevationMap(num_envs=2, device="meta")
    with OneDevice(), NoConstants():
        for poses in (torch.empty(2, 3, 3, device="meta"), torch.empty(2, 3, 4, 4, device="meta")):
            check = check_path(emap, poses, torch.empty(5, 2, device="meta"), samples=4)
            assert check.first_unsafe.shape == (2,) and check.footprints.safe.shape == (2, 9)


def test_bad_values_elsewhere_are_not_safe():
    """As on a GPU, where nothing is read."""
    emap = ground_map(1.0)
    long = check_path(emap, unread(path((-0.5, 0, 0), (0.0, 0, 0), (0.1, 0, 0))), FOOTPRINT, samples=2)
    assert long.footprints.safe.tolist() == [[True, False, False, True, True]] and long.first_unsafe.tolist() == [1]
    lost = check_path(emap, unread(path((-0.1, 0, 0), (0.0, 0, 0), (math.nan, 0, 0))), FOOTPRINT, samples=2)
    assert lost.first_unsafe.tolist() == [2] and not lost.safe.any()


@pytest.mark.parametrize(
    "poses, error, text",
    [
        (torch.zeros(1, 3, 4), ValueError, r"expected \(1, T, 3\) or \(1, T, 4, 4\) with T >= 1, got \(1, 3, 4\)"),
        (torch.zeros(2, 3, 3), ValueError, "got"),
        (torch.zeros(1, 0, 3), ValueError, "T >= 1"),
        (torch.zeros(1), ValueError, "got"),
        ([[0.0, 0.0, 0.0]], TypeError, "must be a torch.Tensor"),
        (torch.zeros(1, 2, 4, 4), ValueError, "rigid"),
        (
            path((0, 0, 0), (0, math.nan, 0)),
            ValueError,
            "must be finite, got NaN or inf; pad by repeating the last pose",
        ),
        (path((-0.5, 0, 0), (0.5, 0, 0)), ValueError, "one cell .*, got 2.67 cells; raise samples to 8, or"),
        (path((0, 0, 0), (0, 0, 3.0)), ValueError, "one cell"),
    ],
)
def test_bad_poses_are_refused(poses, error, text):
    with pytest.raises(error, match=f"poses: .*{text}"):
        check_path(ground_map(), poses, FOOTPRINT, samples=3)


def test_other_bad_arguments_are_refused():
    poses = path((0, 0, 0), (0.1, 0, 0))
    for footprint, text in (
        (FOOTPRINT[:2], r"V >= 3, got \(2, 2\)"),
        (FOOTPRINT[None], "V >= 3"),
        (FOOTPRINT / 0, "finite"),
        (FOOTPRINT * 3, "no wider than max_extent = 1.5 m at any heading, got 1.67705 m; enlarge it"),
    ):
        with pytest.raises(ValueError, match=f"footprint: .*{text}"):
            check_path(ground_map(), poses, footprint)
    with pytest.raises(TypeError, match="cfg: must be a FootprintConfig"):
        check_path(ground_map(), poses, FOOTPRINT, 0.5)
    for samples in (0, 2.0, True):
        with pytest.raises(ValueError, match="samples: must be a positive int"):
            check_path(ground_map(), poses, FOOTPRINT, samples=samples)
