"""The learned head: what holds of it whatever its weights, and its file."""

import dataclasses
import itertools

import numpy as np
import pytest
import torch
from hypothesis import assume, example, given
from torch._subclasses.fake_tensor import FakeTensorMode

from tests.filters.filter_cases import SEEDS, SHAPES, SHARES, hill, in_large_cells
from torchelev.robot import RobotConfig
from torchelev.traversability.features import complete, extremes, features
from torchelev.traversability.net import TraversabilityNet
from torchelev.traversability.rate import rate
from torchelev.traversability.stances import Way, in_cells, stances
from torchelev.traversability.trained_range import RANGES, conditions, ratios
from torchelev.traversability.weight_file import VERSION

ROBOT = RobotConfig()
SMALL = dataclasses.replace(ROBOT, length=0.5, width=0.25, foot_radius=0.02, foot_reach=0.06, step_height=0.15)
CELLS = 0.1  # [m] so that small maps reach beyond a robot


def random_net(seed=0, dtype=torch.float64):
    """A net all of whose weights count."""
    torch.manual_seed(seed)
    net = TraversabilityNet().to(dtype)
    with torch.no_grad():
        for value in net.parameters():
            value.add_(0.3 * torch.randn_like(value))
    return net


def random_maps(seed, shape=(2, 13, 11), share=0.7, dtype=torch.float64):
    """Maps of steps, noise and holes, with garbage where nothing is known."""
    rng = np.random.default_rng(seed)
    known, bounded = (torch.from_numpy(rng.random(shape) < p) for p in (share, 0.5))
    z = np.floor(rng.normal(size=(shape[0], 1, 1)) + np.arange(shape[1])[:, None] / 3) * 0.1
    heights = torch.from_numpy(z + rng.normal(0, 0.05, shape)).to(dtype)
    variance = torch.from_numpy(rng.uniform(0, 1e-3, shape)).to(dtype)
    bound = torch.from_numpy(rng.normal(0, 0.3, shape)).to(dtype)
    garbage = torch.from_numpy(rng.choice([1e3, -1e3, np.nan, np.inf], shape)).to(dtype)
    hold = (torch.where(mask, layer, garbage) for layer, mask in ((heights, known), (variance, known)))
    elevation, variance = hold
    return elevation, known, variance, torch.where(bounded, bound, garbage), bounded


def logits(net, maps, resolution=CELLS, robot=ROBOT):
    return torch.stack(net.logits(*maps, resolution=resolution, robot=robot)).detach()


@pytest.mark.slow(5)
@given(SEEDS)
@pytest.mark.parametrize("turns", range(4))
@pytest.mark.parametrize("mirrored", [False, True])
@pytest.mark.parametrize("robot", [ROBOT, SMALL])
def test_turns_and_mirrors_with_the_map(turns, mirrored, robot, seed):
    net, maps = random_net(seed), random_maps(seed)

    def move(layer):
        return torch.rot90(layer.flip(-1) if mirrored else layer, turns, (-2, -1))

    expected = move(logits(net, maps, robot=robot))
    got = logits(net, [move(layer) for layer in maps], robot=robot)
    torch.testing.assert_close(got, expected, atol=1e-9, rtol=0)
    assume((got.amax((1, 2, 3)) - got.amin((1, 2, 3)) > 1e-3).all())  # few random nets answer the same everywhere


@pytest.mark.slow(1)
@given(SEEDS)
def test_altitude_changes_nothing(seed):
    net = random_net(seed)
    elevation, known, variance, bound, bounded = random_maps(seed)
    low = logits(net, (elevation, known, variance, bound, bounded))
    high = logits(net, (elevation + 500, known, variance, bound + 500, bounded))
    torch.testing.assert_close(high, low, atol=1e-9, rtol=0)
    # What float32 keeps of heights at 500 m is good to 0.03 mm.
    single = [layer.float() if layer.is_floating_point() else layer for layer in random_maps(seed)]
    raised = [single[0] + 500, *single[1:3], single[3] + 500, single[4]]
    net = net.float()
    torch.testing.assert_close(logits(net, raised), logits(net, single), atol=5e-3, rtol=0)


def test_a_window_that_moves_by_cells_rates_the_same_ground_the_same():
    net, maps = random_net(), random_maps(3, (1, 40, 38))
    rim = in_cells(ROBOT, CELLS).rim
    whole, part = logits(net, maps), logits(net, [layer[:, 3:, 5:] for layer in maps])
    torch.testing.assert_close(part[:, :, rim:, rim:], whole[:, :, 3 + rim :, 5 + rim :], atol=1e-9, rtol=0)


def test_the_rim_of_a_map_is_unknown_ground():
    net, maps = random_net(), random_maps(4)
    wider = [torch.nn.functional.pad(layer, [4, 3, 2, 5]) for layer in maps]
    got = logits(net, wider)[:, :, 2:-5, 4:-3]
    torch.testing.assert_close(got, logits(net, maps), atol=1e-9, rtol=0)


@pytest.mark.slow(1)
@given(SEEDS)
def test_batch_is_single(seed):
    net, maps = random_net(seed), random_maps(seed, (3, 9, 8))
    both = logits(net, maps)
    for b in range(3):
        torch.testing.assert_close(both[:, b : b + 1], logits(net, [m[b : b + 1] for m in maps]), atol=1e-9, rtol=0)


@pytest.mark.slow(1)
@given(SEEDS)
def test_what_unknown_cells_hold_changes_nothing(seed):
    net, maps, other = random_net(seed), random_maps(seed), random_maps(seed + 1)
    elevation, known, variance, bound, bounded = maps
    swapped = [torch.where(mask, a, b) for a, b, mask in
               ((elevation, other[0], known), (variance, other[2], known), (bound, other[3], bounded))]  # fmt: skip
    got = logits(net, (swapped[0], known, swapped[1], swapped[2], bounded))
    torch.testing.assert_close(got, logits(net, maps), atol=1e-9, rtol=0)


@pytest.mark.parametrize("seed", range(3))
def test_resolutions_agree_on_smooth_ground(seed):
    # With random weights, but for the resolution as an input: what is left is that windows are whole cells.
    net = random_net(seed, torch.float32)
    with torch.no_grad():
        for condition in (net.cell_condition, net.stance_condition):
            condition[:, list(RANGES).index("resolution / robot.length")] = 0
    maps = []
    for resolution in (0.02, 0.04, 0.08):
        rated = net(*hill(resolution), resolution=resolution, robot=ROBOT).traversability.detach()
        maps.append(in_large_cells((rated, torch.ones_like(rated) > 0), resolution)[:, 12:-12, 12:-12])
    stacked = torch.stack(maps)
    assert (stacked.amax(0) - stacked.amin(0)).max() < 0.1


@pytest.mark.slow(1)
@given(SEEDS, SHAPES, SHARES)
@example(0, (1, 1, 1), 1.0)
@example(0, (1, 1, 7), 1.0)
@example(0, (2, 6, 6), 0.0)
def test_answers_and_gradients_are_finite(seed, shape, share):
    net = random_net(seed, torch.float32)
    elevation, known, variance, bound, bounded = random_maps(seed, shape, share, torch.float32)
    leaves = [layer.clone().requires_grad_() for layer in (elevation, variance, bound)]
    rating = net(leaves[0], known, leaves[1], leaves[2], bounded, resolution=CELLS, robot=ROBOT)
    for layer in rating:
        assert layer.shape == shape and ((layer >= 0) & (layer <= 1)).all()
    sum(layer.sum() for layer in rating).backward()
    for leaf, counts in zip(leaves, (known, known, bounded & ~known), strict=True):
        assert torch.isfinite(leaf.grad).all() and (leaf.grad[~counts] == 0).all()


@pytest.mark.parametrize("value", [torch.nan, torch.inf])
def test_what_is_not_finite_counts_as_unknown(value):
    net, (elevation, known, *rest) = random_net(), random_maps(0)
    known[0, 6, 5] = False
    expected = logits(net, (elevation, known, *rest))
    elevation, known = elevation.clone(), known.clone()
    elevation[0, 6, 5], known[0, 6, 5] = value, True
    assert torch.equal(logits(net, (elevation, known, *rest)), expected)


def test_gradients_on_flat_ground_are_finite():
    flat = torch.zeros(1, 12, 12, requires_grad=True)
    rating = random_net(0, torch.float32)(flat, torch.ones(1, 12, 12) > 0, resolution=CELLS, robot=ROBOT)
    rating.traversability.sum().backward()
    assert torch.isfinite(flat.grad).all()


@pytest.mark.slow(2)
def test_gradcheck():
    net = random_net(2)
    _, known, variance, _, bounded = random_maps(5, (1, 6, 5), 0.8)
    # Heights apart from each other, and differences too, so that no finite step changes their order.
    generator = torch.Generator().manual_seed(3)
    apart = (0.6 + 0.8 * torch.rand(30, generator=generator, dtype=torch.float64)).cumsum(0)
    order = apart[torch.randperm(30, generator=generator)].view(1, 6, 5)
    leaves = [
        (0.03 * order).requires_grad_(),
        (1e4 * variance * known).requires_grad_(),  # [cm^2], as small as a finite step must be to pass no kink
        (0.03 * order - 0.31).requires_grad_(),
    ]

    def answers(z, v, u):
        return net.logits(z, known, 1e-4 * v, u, bounded, resolution=CELLS, robot=ROBOT)

    assert torch.autograd.gradcheck(answers, leaves, atol=1e-5)


def test_gradients_reach_every_weight():
    net = random_net()
    sum(layer.sum() for layer in net(*random_maps(0), resolution=CELLS, robot=SMALL)).backward()
    for name, value in net.named_parameters():
        assert torch.isfinite(value.grad).all() and value.grad.any(), name


def test_nothing_known_gets_the_answer_of_far_unknown_ground():
    net = random_net()
    maps = list(random_maps(0, (1, 60, 8)))
    maps[0], maps[2] = (maps[k].nan_to_num(0.0, 0.0, 0.0) for k in (0, 2))
    maps[1] = torch.zeros_like(maps[1])
    nothing = logits(net, maps)
    unbounded = logits(net, (*maps[:4], torch.zeros_like(maps[4])))
    torch.testing.assert_close(unbounded, unbounded[:, :, :1, :1].expand_as(unbounded), atol=1e-12, rtol=0)
    maps[1][:, :5] = True
    far = logits(net, maps)
    torch.testing.assert_close(far[:, :, 45:], nothing[:, :, 45:], atol=1e-12, rtol=0)
    assert not torch.allclose(far[:, :, :8], nothing[:, :, :8], atol=1e-3)


@pytest.mark.slow(1)
def test_never_waits():
    with FakeTensorMode():
        net, layer, mask = TraversabilityNet(), torch.zeros(2, 9, 8), torch.ones(2, 9, 8, dtype=torch.bool)
        rating = net(layer, mask, layer, layer, mask, resolution=CELLS, robot=ROBOT)
    assert all(answer.shape == (2, 9, 8) for answer in rating)


@pytest.mark.parametrize("dtype", [torch.float16, torch.bfloat16])
def test_half_precision_is_rated_in_float32(dtype):
    """To what the heights' own rounding makes of it."""
    net, maps = random_net(0, torch.float32), random_maps(0, (1, 20, 17), dtype=torch.float32)
    coarse = [layer.to(dtype) if layer.is_floating_point() else layer for layer in maps]
    exact = [layer.float() if layer.is_floating_point() else layer for layer in coarse]
    got = logits(net.to(dtype), coarse)
    assert got.dtype == torch.float32 and got.isfinite().all()
    torch.testing.assert_close(got, logits(net.float(), exact), atol=1e-5, rtol=1e-5)


@pytest.mark.compiles
@pytest.mark.slow(26)
def test_traces_as_one_graph():
    net, maps = random_net(0, torch.float32), random_maps(0, (1, 20, 17), dtype=torch.float32)

    def run(weights, *layers):
        return rate(weights, *layers, resolution=0.08, robot=ROBOT)

    with torch.no_grad():
        compiled = torch.compile(run, fullgraph=True, backend="eager")(net.weights, *maps)
        for got, expected in zip(compiled, run(net.weights, *maps), strict=True):
            torch.testing.assert_close(got, expected)


# What it sees --------------------------------------------------------------------------------------------------------


def test_stances_by_hand():
    robot = RobotConfig(length=0.8, width=0.4)
    along, turned, across, _ = stances(robot, 0.1)
    assert along.feet == ((4, 2), (4, -2), (-4, 2), (-4, -2)) and (along.length, along.width) == (8, 4)
    assert along.spine == ((0, 0), (2, 0), (-2, 0))  # squares of 0.4 m: the body ends 0.4 m from its middle
    # 4 and 8 cells, in steps of 3 or less: each way from the left or front feet to the others.
    assert along.ways == {
        Way((0, -4), ((0, -2),), 2): [(4, 2), (-4, 2)],
        Way((-8, 0), ((-3, 0), (-5, 0)), 3): [(4, 2), (4, -2)],
    }
    assert turned.feet == ((-2, 4), (2, 4), (-2, -4), (2, -4))
    # Half the diagonals of length + width and length - width: 0.424 m and 0.141 m.
    assert across.feet == ((1, 4), (4, 1), (-4, -1), (-1, -4))
    assert (across.length, across.width) == pytest.approx((5 * 2**0.5, 3 * 2**0.5))
    # Half of 5 cells, rounded to even from where each way lies: not alike, but mirror images.
    assert [way.places for way in across.ways] == [(), ((-3, -2),), ((-2, -3),)]
    assert list(across.ways.values()) == [[(1, 4), (-4, -1)], [(1, 4)], [(4, 1)]]


@pytest.mark.parametrize("resolution", [0.02, 0.03, 0.04, 0.1])
@pytest.mark.parametrize("robot", [ROBOT, SMALL, RobotConfig(length=0.4, width=0.16)])
def test_the_windows_between_feet_leave_no_cell_out(robot, resolution):
    for stance in stances(robot, resolution):
        a, b, c, d = stance.feet
        found = {((i, j), (i + way.end[0], j + way.end[1])) for way, starts in stance.ways.items() for i, j in starts}
        assert found == {(a, b), (c, d), (a, c), (b, d)}
        for way in stance.ways:
            for p, q in itertools.pairwise(((0, 0), *way.places, way.end)):
                assert max(abs(p[0] - q[0]), abs(p[1] - q[1])) <= 3


@pytest.mark.parametrize("resolution", [0.01, 0.02, 0.04, 0.1, 0.15])
@pytest.mark.parametrize("robot", [ROBOT, SMALL, RobotConfig(length=0.4, width=0.16)])
def test_no_two_feet_share_a_cell(robot, resolution):
    for stance in stances(robot, resolution):
        assert len(set(stance.feet)) == 4
        assert stance.length * resolution == pytest.approx(robot.length, abs=1.5 * resolution)


def test_windows_by_hand():
    # Reach 0.1 m, half the width 0.2 m, half the length 0.35 m.
    assert in_cells(ROBOT, 0.04).steps == ((1,), (1,), (3,), (4,)) and in_cells(ROBOT, 0.04).radii == (1, 2, 5, 9)
    assert in_cells(ROBOT, 0.02).steps == ((1,), (3, 1), (5,), (8,))  # from 1 to 5 cells at once would leave one out
    assert in_cells(ROBOT, 0.1).steps == ((1,), (), (1,), (1,)) and in_cells(ROBOT, 0.1).radii == (1, 1, 2, 3)


def test_unknown_cells_are_completed_below_their_bound():
    scales = in_cells(ROBOT, CELLS)
    known = torch.ones(1, 9, 9, dtype=torch.float64) > 0
    known[0, 4, 4] = known[0, 2, 2] = False
    bound = torch.full((1, 9, 9), 4.8, dtype=torch.float64)
    bounded = torch.zeros_like(known)
    bounded[0, 2, 2] = True
    z = torch.full((1, 9, 9), 5.0, dtype=torch.float64)
    ground = complete(z, known, torch.zeros_like(z), bound, bounded, scales)
    middle = slice(scales.margin, -scales.margin)
    height = ground.height[0, middle, middle]
    expected = torch.zeros(9, 9, dtype=torch.float64)
    expected[2, 2] = -0.2
    torch.testing.assert_close(height, expected, atol=1e-12, rtol=0)


def test_flat_ground_is_seen_as_flat():
    scales = in_cells(ROBOT, CELLS)
    z, known = torch.full((1, 15, 15), 3.0, dtype=torch.float64), torch.ones(1, 15, 15) > 0
    ground = complete(z, known, torch.zeros_like(z), z, ~known, scales)
    seen = torch.stack(features(ground, extremes(ground, scales), scales, CELLS, ROBOT), 1)
    middle = seen[0, :, seen.shape[2] // 2, seen.shape[3] // 2]
    torch.testing.assert_close(middle[:5], torch.ones(5, dtype=torch.float64))  # shares of known cells
    torch.testing.assert_close(middle[5:], torch.zeros(13, dtype=torch.float64), atol=1e-12, rtol=0)


def test_robots_at_the_ends_of_the_ranges_are_told_by_ones():
    name = "resolution / robot.length"
    number, (low, high) = list(RANGES).index(name), RANGES[name]
    got = [conditions(ROBOT, ROBOT.length * ratio)[number] for ratio in (low, (low * high) ** 0.5, high)]
    assert got == pytest.approx([-1, 0, 1])


# Its file, and refusals ----------------------------------------------------------------------------------------------


def test_saved_and_loaded_it_is_the_same(tmp_path):
    net = TraversabilityNet(6, 5, {**RANGES, "robot.step_height": (0.1, 0.5)})
    net.save(tmp_path / "w.pt")
    again = TraversabilityNet.from_pretrained(tmp_path / "w.pt")
    maps = random_maps(0, dtype=torch.float32)
    assert torch.equal(logits(net, maps), logits(again, maps))
    assert again.config == net.config


def spoilt(fault):
    net = TraversabilityNet()
    found = {"version": VERSION, "config": net.config, "state_dict": dict(net.state_dict())}
    if fault == "version":
        found |= {"version": VERSION + 1, "config": {"other": 1}}
    elif fault == "ranges":
        found["config"] = net.config | {"ranges": 3}
    elif fault == "type":
        found["config"] = net.config | {"cell_channels": "12"}
    elif fault == "no tensor":
        found["state_dict"]["foot"] = 1.0
    elif fault == "shape":
        found["state_dict"]["foot"] = torch.zeros(3, 3)
    elif fault == "missing":
        del found["state_dict"]["answer_bias"]
    elif fault == "config":
        found["config"] = {"channels": 3}
    elif fault == "nan":
        found["state_dict"]["foot"] = torch.full_like(found["state_dict"]["foot"], torch.nan)
    else:
        del found["config"]
    return found


@pytest.mark.parametrize(
    ("fault", "words"),
    [
        ("version", f"must be of version {VERSION}, got {VERSION + 1}"),
        ("shape", r"foot \(3, 3\) instead of"),
        ("missing", "answer_bias None instead of"),
        ("config", "must be a file of weights"),
        ("ranges", "must be a file of weights"),
        ("type", "must be a file of weights"),
        ("no tensor", "must be a file of weights"),
        ("nan", "must be finite, got NaN or inf in foot"),
        ("none", "must be a file of weights"),
    ],
)
def test_refuses_weights(tmp_path, fault, words):
    torch.save(spoilt(fault), tmp_path / "w.pt")
    with pytest.raises(ValueError, match=words):
        TraversabilityNet.from_pretrained(tmp_path / "w.pt")


def test_refuses_files(tmp_path):
    with pytest.raises(FileNotFoundError, match="no file; train weights"):
        TraversabilityNet.from_pretrained(tmp_path / "none.pt")
    for content in (b"", b"no weights"):
        (tmp_path / "text.pt").write_bytes(content)
        with pytest.raises(ValueError, match="text.pt: must be a file of weights"):
            TraversabilityNet.from_pretrained(tmp_path / "text.pt")
    with pytest.raises(ValueError, match="must be a file of weights"):
        TraversabilityNet.from_pretrained(tmp_path)
    torch.save([1, 2], tmp_path / "list.pt")
    with pytest.raises(ValueError, match="list.pt: must be a file of weights"):
        TraversabilityNet.from_pretrained(tmp_path / "list.pt")


@pytest.mark.parametrize("resolution", [0.005, 0.2, float("nan")])
def test_refuses_resolutions(resolution):
    with pytest.raises(ValueError, match=r"resolution: must be 0.02 to 0.1 m"):
        TraversabilityNet()(*random_maps(0), resolution=resolution, robot=ROBOT)


@pytest.mark.parametrize("name", list(RANGES))
def test_refuses_robots_that_it_was_not_trained_for(name):
    value = ratios(ROBOT, CELLS)[name]
    for limits in ((value * 1.01, value * 2), (value / 2, value / 1.01)):
        net = TraversabilityNet(ranges={**RANGES, name: limits}).double()
        with pytest.raises(ValueError, match=r"as trained, got .*; train a head for this robot"):
            net(*random_maps(0), resolution=CELLS, robot=ROBOT)


@pytest.mark.parametrize(
    ("number", "layer", "words"),
    [
        (0, torch.zeros(13, 11), r"elevation: must be \(B, H, W\)"),
        (0, torch.zeros(2, 13, 11, dtype=torch.int64), "elevation: must be"),
        (1, torch.zeros(2, 13, 11), "validity: must be"),
        (2, torch.zeros(2, 13, 10), "variance: must be"),
        (3, None, "upper_bound, bounded: must come together"),
        (4, torch.zeros(1, 13, 11) > 0, "bounded: must be"),
    ],
)
def test_refuses_layers(number, layer, words):
    maps = list(random_maps(0, dtype=torch.float32))
    maps[number] = layer
    with pytest.raises(ValueError, match=words):
        TraversabilityNet()(*maps, resolution=CELLS, robot=ROBOT)
