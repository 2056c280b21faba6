"""Height scans: presets by hand-worked numbers, against loops, and how they run."""

import copy
import dataclasses
import math

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from torch._subclasses.fake_tensor import FakeTensorMode

from tests.devices import unread
from tests.helpers import pose, small_map
from tests.observations.loops import loop_scan
from tests.observations.maps import BASE, SEEDS, at, flat, ground_map, near, plane, random_base, random_map
from torchelev import ElevationMap
from torchelev.observations.fill import FILLS, MODES
from torchelev.observations.height_scan import HeightScan
from torchelev.observations.map_image import CHANNELS as ALL
from torchelev.observations.map_image import MapImage
from torchelev.observations.patterns import ALIGNMENTS
from torchelev.observations.scan.presets import PRESETS

# The presets, worked out by hand: the base at (0.3, -0.2, 0.7) looks along +y, so that the pattern's point (x, y) lies
# at (0.3 - y, -0.2 + x). Ground 0.1 x + 0.2 y:
#   (-0.8, -0.5) -> (0.8, -1.0): -0.12    (-0.7, -0.5) -> (0.8, -0.9): -0.10
#   (-0.8, -0.4) -> (0.7, -1.0): -0.13    ( 0.8,  0.5) -> (-0.2, 0.6):  0.10


CHANNELS = tuple(name for name in ALL if name != "clearance")  # of maps without levels


def test_isaac_lab_on_a_tilted_plane():
    scan = HeightScan.isaac_lab()
    values, valid = scan(ground_map(plane), pose(BASE, yaw=math.pi / 2))
    assert scan.num_points == 187 and values.shape == valid.shape == (1, 187) and valid.all()
    assert at(values, 0, 1, 17, 186) == near(0.7 + 0.12 - 0.5, 0.30, 0.33, 0.10)


def test_mjlab_on_a_tilted_plane():
    values, _ = HeightScan.mjlab()(ground_map(plane), pose(BASE, yaw=math.pi / 2))
    assert at(values, 0, 1, 17, 186) == near((0.7 + 0.12) / 5, 0.160, 0.166, 0.120)


def test_legged_gym_on_a_tilted_plane():
    emap, T = ground_map(plane), pose(BASE, yaw=math.pi / 2)
    values, _ = HeightScan.legged_gym(mode="bilinear")(emap, T)
    assert at(values, 0, 1, 11, 186) == near(5 * (0.7 + 0.12 - 0.5), 1.65, 1.50, 0.50)
    # The lowest cell around (0.8, -1.0) has its centre at (0.75, -1.05): 0.075 - 0.21 = -0.135.
    assert at(HeightScan.legged_gym()(emap, T)[0], 0) == near(5 * (0.7 + 0.135 - 0.5))


def test_legged_gym_is_isaac_lab_transposed():
    rng = np.random.default_rng(0)
    emap = ground_map(lambda x, y: torch.from_numpy(rng.uniform(-0.3, 0.3, x.shape)))
    T = pose(BASE, yaw=0.7, pitch=0.2, roll=-0.1)
    isaac, legged = HeightScan.isaac_lab()(emap, T)[0], HeightScan.legged_gym(mode="bilinear")(emap, T)[0]
    torch.testing.assert_close(legged.view(17, 11).T / 5, isaac.view(11, 17))
    assert (isaac.view(11, 17)[0] - isaac.view(11, 17)[1]).abs().min() > 1e-6


def test_presets_clip_before_or_after_the_scale():
    """Base 3 m over the ground: Isaac Lab clips 2.5 to 1, mjlab has no clip, legged_gym clips, then scales."""
    emap, T = ground_map(flat), pose((0.3, -0.2, 3.0))
    assert [float(HeightScan.preset(name)(emap, T)[0][0, 5]) for name in PRESETS] == [1.0, pytest.approx(0.6), 5.0]
    T = pose((0.3, -0.2, -3.0))
    assert [float(HeightScan.preset(name)(emap, T)[0][0, 5]) for name in PRESETS] == [-1.0, pytest.approx(-0.6), -5.0]


def test_presets_can_read_what_their_originals_read_of_a_miss():
    """Isaac Lab clips -inf to -1, mjlab reads 5 m / 5; legged_gym never misses, so flat ground."""
    emap = ground_map(flat, validity=False)
    for name, miss in zip(PRESETS, (-1.0, 1.0, 0.0), strict=True):
        values, valid = HeightScan.preset(name, fill="original")(emap, pose(BASE))
        assert (values == miss).all() and not valid.any()


@pytest.mark.parametrize("name", PRESETS)
@pytest.mark.parametrize("standing", [None, 0.3, 0.8])
def test_an_empty_map_reads_as_flat_ground_under_a_standing_robot(name, standing):
    settings = {} if standing is None else dict(standing_height=standing)
    height = 0.5 if standing is None else standing
    scan, T = HeightScan.preset(name, **settings), pose((0.3, -0.2, height))
    values, valid = scan(ground_map(flat, validity=False), T)
    torch.testing.assert_close(values, scan(ground_map(flat), T)[0])
    assert not valid.any() and values[0, 0] == values[0, 5]
    # Higher up nothing says where the ground is: as of a robot that stands.
    torch.testing.assert_close(scan(ground_map(flat, validity=False), pose((0.3, -0.2, 7.0)))[0], values)


def test_noise_comes_where_the_originals_have_it():
    """Draws of 0 and 1 are -0.1 and +0.1 m."""
    low, high = torch.zeros(1, 187), torch.ones(1, 187)
    emap, T = ground_map(flat), pose(BASE)
    read = {name: HeightScan.preset(name) for name in PRESETS}
    for u, error in ((low, -0.1), (high, 0.1)):
        assert at(read["isaac_lab"](emap, T, noise=u)[0], 3) == near(0.2 + error)
        assert at(read["mjlab"](emap, T, noise=u)[0], 3) == near((0.7 + error) / 5)
        assert at(read["legged_gym"](emap, T, noise=u)[0], 3) == near(5 * (0.2 + error))
    above = pose((0.3, -0.2, 3.0))
    assert at(read["isaac_lab"](emap, above, noise=high)[0], 3) == near(1.0)
    assert at(read["legged_gym"](emap, above, noise=high)[0], 3) == near(5.5)
    blank = ground_map(flat, validity=False)
    assert [at(read[n](blank, T, noise=high)[0], 3)[0] for n in PRESETS] == pytest.approx([0.1, 0.12, 0.5])


def test_feet_on_a_tilted_plane():
    """The second foot at (0.5, 0.1, 0.4): its first point lies 8 cm ahead, along +y: h = 0.05 + 0.2 * 0.18."""
    feet = torch.tensor([[[0.1, -0.4, 0.2], [0.5, 0.1, 0.4]]], dtype=torch.float64)
    scan = HeightScan.feet(num_feet=2, reach=0.5)
    values, valid = scan(ground_map(plane), pose(BASE, yaw=math.pi / 2), feet)
    assert values.shape == (1, 104) and valid.all()
    # Of the second ring, the third point is 16 cm to the left: x = 0.34.
    assert at(values, 52, 52 + 8) == near(0.4 - 0.086, 0.4 - 0.034 - 0.02)
    assert at(values, 0) == near(0.2 - 0.01 + 0.2 * 0.32)


# Against slow loops ---------------------------------------------------------------------------------------------------


@pytest.mark.slow(1)
@given(SEEDS, st.sampled_from(ALIGNMENTS), st.sampled_from(MODES), st.sampled_from([*FILLS, 0.35]), st.booleans())
def test_scans_agree_with_loops(seed, alignment, mode, fill, at_feet):
    emap, rng = random_map(seed)
    T = random_base(emap, rng)
    settings = dict(alignment=alignment, mode=mode, fill=fill, nominal_height=0.4, inpaint_rings=2, scale=2.0, clip=0.5)
    settings |= dict(standing_height=0.6)
    feet = None
    if at_feet:
        scan = HeightScan.feet(num_feet=2, rings=[(0.0, 1), (0.15, 5)], reach=0.3, **settings)
        feet = T[:, None, :3, 3] + torch.from_numpy(rng.uniform(-0.2, 0.2, (2, 2, 3)))
    else:
        scan = HeightScan.points(rng.uniform(-0.5, 0.5, (40, 2)), **settings)
    values, valid = scan(emap, T, feet)
    for b in range(2):
        expected, known = loop_scan(scan, emap, T, feet, b)
        assert np.array_equal(valid[b].numpy(), known)
        np.testing.assert_allclose(values[b].numpy(), expected, atol=1e-9)


def test_the_random_maps_have_every_kind_of_cell():
    emap, rng = random_map(0)
    scan = HeightScan.points(rng.uniform(-0.5, 0.5, (200, 2)), nominal_height=0.4)
    T = random_base(emap, rng)
    reads = {fill: dataclasses.replace(scan, fill=fill, inpaint_rings=1)(emap, T) for fill in FILLS}
    valid = reads["base"][1]
    assert 0.3 < valid.double().mean() < 0.8 and all(torch.equal(valid, v) for _, v in reads.values())
    for fill in set(FILLS) - {"base"}:
        differs = reads[fill][0] != reads["base"][0]
        assert differs.any() and not (differs & valid).any()
    assert (reads["upper_bound"][0] == 0).any() and (reads["inpaint"][0] == 0).any(), "some have no answer"


@pytest.mark.slow(2)
@pytest.mark.parametrize("fill", [*FILLS, 1.5])
@pytest.mark.parametrize("known", [0.0, 0.5, 1.0])
def test_values_are_never_nan(fill, known):
    emap, rng = random_map(3, known=known, dtype=torch.float32)
    T, image = random_base(emap, rng), MapImage(length_x=0.8, length_y=0.8, layers=CHANNELS)
    scan = HeightScan.isaac_lab(length_x=1.0, length_y=0.8, fill=fill)
    for place in ((slice(None), 2, 3), (0, 0, 3), (1, slice(0, 3), slice(0, 3))):
        broken = T.clone()
        broken[place] = torch.nan
        for bad in (T, broken, torch.where(broken.isnan(), torch.inf, broken)):
            values, valid = scan(emap, unread(bad))
            assert values.isfinite().all() and image(emap, unread(bad)).isfinite().all()
        assert not valid[1 if place[0] == 1 else 0].any()
        assert not image(emap, unread(broken))[1 if place[0] == 1 else 0].any()


def test_observations_are_fresh():
    """A policy keeps what it saw while the map goes on."""
    emap, rng = random_map(1, dtype=torch.float32)
    T = random_base(emap, rng)
    before = {name: value.clone() for name, value in emap.state_dict().items() if isinstance(value, torch.Tensor)}
    for scan in (HeightScan.points([(0.1, 0.2)], fill=fill, mode=mode) for fill in FILLS for mode in MODES):
        for tensor in scan(emap, T):
            tensor.fill_(1)
    for layer in CHANNELS:
        MapImage(length_x=0.4, length_y=0.4, layers=(layer,))(emap, T).fill_(7.0)
    now = emap.state_dict()
    assert all(torch.equal(value.nan_to_num(), now[name].nan_to_num()) for name, value in before.items())


# Precision, gradients, modes of running -------------------------------------------------------------------------------


def test_scans_are_right_100_km_from_the_origin():
    emap, rng = random_map(5, 1, dtype=torch.float32)
    T = random_base(emap, rng)
    scan = HeightScan.points(rng.uniform(-0.5, 0.5, (60, 2)))
    readers = scan, dataclasses.replace(scan, mode="nearest"), MapImage(length_x=0.8, length_y=0.8)
    expected = [reader(emap, T) for reader in readers]
    emap.corner += torch.tensor([1_000_000, -1_000_000])
    T[:, :2, 3] += torch.tensor([100_000.0, -100_000.0], dtype=torch.float64)
    torch.testing.assert_close([reader(emap, T) for reader in readers], expected, atol=2e-5, rtol=0)


def test_a_batch_reads_as_single_maps():
    emap, rng = random_map(6)
    T = random_base(emap, rng)
    scan = HeightScan.points(rng.uniform(-0.5, 0.5, (30, 2)), fill="lowest")
    for b in range(2):
        single = small_map(1, (20, 18), dtype=torch.float64)
        single.load_state(type(emap.state)(*(v[b : b + 1] for v in emap.state[:-1]), single.statistics))
        assert torch.equal(scan(single, T[b : b + 1])[0], scan(emap, T)[0][b : b + 1])


def test_readers_take_a_state():
    (one, rng), (other, _) = random_map(1), random_map(2)
    T = random_base(one, rng)
    scan = HeightScan.points(rng.uniform(-0.5, 0.5, (30, 2)), fill="upper_bound")
    image = MapImage(length_x=0.8, length_y=0.8)
    torch.testing.assert_close(scan(one, T, state=other.state), scan(other, T))
    assert torch.equal(image(one, T, state=other.state), image(other, T))
    assert not torch.equal(scan(one, T)[0], scan(other, T)[0])


def turned(T, position, angle):
    """A pose moved by `position` (B, 3) and turned by `angle` (B,) about the vertical, both differentiable."""
    c, s, zero, one = angle.cos(), angle.sin(), torch.zeros_like(angle), torch.ones_like(angle)
    R = torch.stack([c, -s, zero, s, c, zero, zero, zero, one], -1).view(-1, 3, 3)
    top = torch.cat([R @ T[:, :3, :3], (T[:, :3, 3] + position)[..., None]], -1)
    return torch.cat([top, T[:, 3:]], 1)


@pytest.mark.slow(1)
@pytest.mark.parametrize("alignment", ALIGNMENTS)
@pytest.mark.parametrize("fill", FILLS)
def test_gradcheck_of_map_and_pose(alignment, fill):
    emap, rng = random_map(8)
    T, state = random_base(emap, rng), emap.state
    scan = HeightScan.points(rng.uniform(-0.5, 0.5, (12, 2)), alignment=alignment, fill=fill, scale=3.0)
    inputs = state.elevation.nan_to_num(), torch.zeros(2, 3).double(), torch.zeros(2).double()
    inputs = tuple(value.clone().requires_grad_() for value in inputs)

    def read(elevation, position, angle):
        return scan(emap, turned(T, position, angle), state=state._replace(elevation=elevation))[0]

    assert torch.autograd.gradcheck(read, inputs, eps=1e-7, atol=1e-5, fast_mode=True)
    grads = torch.autograd.grad(read(*inputs).square().sum(), inputs, allow_unused=True)
    assert grads[0].abs().sum() > 0 and (grads[1].abs() > 0).all()
    assert (grads[2] is None or not grads[2].any()) == (alignment == "world")
    assert not grads[0][~emap.validity].any(), "unknown cells have no say"


def test_gradients_of_feet_and_images():
    emap, rng = random_map(9)
    T = random_base(emap, rng).requires_grad_()
    feet = (T.detach()[:, None, :3, 3] + torch.from_numpy(rng.uniform(-0.1, 0.1, (2, 2, 3)))).requires_grad_()
    HeightScan.feet(num_feet=2, rings=[(0.1, 4)], reach=0.3)(emap, T, feet)[0].square().sum().backward()
    assert (feet.grad != 0).all() and T.grad.isfinite().all() and T.grad[:, :2, 0].any()
    elevation = emap.elevation.nan_to_num().requires_grad_()
    image = MapImage(length_x=0.8, length_y=0.8)
    image(emap, T.detach(), state=emap.state._replace(elevation=elevation))[:, 0].sum().backward()
    assert elevation.grad.isfinite().all() and elevation.grad.any()


@pytest.mark.compiles
@pytest.mark.slow(4)
@pytest.mark.parametrize("warm", [True, False])
def test_scans_compile_as_one_graph(warm):
    """Also a scan whose pattern has not been on the device before."""
    emap, rng = random_map(4, dtype=torch.float32)
    T, u = random_base(emap, rng), torch.rand(2, 30)
    fills, modes = ((*FILLS, 0.5), MODES) if warm else (FILLS[:1], MODES[:1])
    scans = [HeightScan.points(rng.uniform(-0.5, 0.5, (30, 2)), fill=fill, noise=0.1) for fill in fills]
    images = [MapImage(length_x=0.8, length_y=0.8, mode=mode) for mode in modes]
    feet = HeightScan.feet(num_feet=2, rings=[(0.1, 3)], reach=0.4)

    def read(T, u, scans, images, feet):
        middles = T[:, None, :3, 3].repeat(1, 2, 1)
        read = [scan(emap, T, noise=u) for scan in scans]
        return read, [image(emap, T) for image in images], feet(emap, T, middles)

    expected = read(T, u, *copy.deepcopy((scans, images, feet)))
    if warm:
        read(T, u, scans, images, feet)
    compiled = torch.compile(read, fullgraph=True, backend="eager")
    torch.testing.assert_close(compiled(T, u, scans, images, feet), expected)


@pytest.mark.slow(2)
def test_nothing_waits_for_the_device():
    with FakeTensorMode():
        emap, T = ElevationMap(num_envs=2), torch.zeros(2, 4, 4, dtype=torch.float64)
        for mode in MODES:
            for fill in (*FILLS, 0.5):
                scan = HeightScan.grid(mode=mode, fill=fill, noise=0.1, clip=1.0)
                assert scan(emap, T, noise=True)[0].shape == (2, 187)
            for alignment in ALIGNMENTS:
                assert MapImage(alignment=alignment, mode=mode)(emap, T).shape == (2, 4, 32, 32)
        assert HeightScan.feet()(emap, T, torch.zeros(2, 4, 3))[0].shape == (2, 208)
