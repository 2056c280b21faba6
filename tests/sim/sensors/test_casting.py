"""Rays at boxes, devices and chunks, and what `cast` refuses."""

import math

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from torch._subclasses.fake_tensor import FakeTensorMode

from tests.devices import NoConstants, OneDevice, needs_gpu, never_wait
from tests.helpers import rotation
from tests.sim.sensors.ray_cases import flat, one, same, scene, unit
from torchelev.sim.sensors.casting import MAX_RAYS, Boxes, cast
from torchelev.sim.terrains.heightfield import HeightField


@pytest.mark.parametrize("rays", [MAX_RAYS // 2, MAX_RAYS + 1], ids=["two environments", "a part of one"])
def test_parts_make_the_whole(rays):
    field, tiles, origin, d = scene(2, B=5)
    boxes = Boxes(torch.eye(4).expand(5, 1, 4, 4) + 0, torch.rand(5, 1, 3))
    whole = cast(field, tiles, origin, d, 3.0, boxes)
    upwards = torch.tensor([0.0, 0.0, 1.0], dtype=d.dtype).expand(5, rays - d.shape[1], 3)
    same(cast(field, tiles, origin, torch.cat([d, upwards], 1), 3.0, boxes)[:, : d.shape[1]], whole)


def box(position, half_size, yaw=0.0, pitch=0.0, roll=0.0):
    T = torch.eye(4, dtype=torch.float64)
    T[:3, :3] = torch.from_numpy(rotation(yaw, pitch, roll))
    T[:3, 3] = torch.tensor(position, dtype=torch.float64)
    return Boxes(T[None, None], torch.tensor([[half_size]], dtype=torch.float64))


def test_faces_of_a_box():
    cube, o = box((2.0, 0.0, 1.0), (0.5, 0.25, 0.1)), (0.0, 0.0, 1.0)
    rays = [[1.0, 0, 0], [-1.0, 0, 0], [2.0, 0.24, 0], [1.5, 0.26, 0], [0, 0, 1.0]]
    expected = torch.tensor([1.5, math.inf, 1.5 * math.hypot(1, 0.12), math.inf, math.inf])
    torch.testing.assert_close(one(flat(), o, rays, 5.0, cube), expected, atol=1e-5, rtol=0)
    assert float(one(flat(), (2.0, 0.1, 3.0), [0, 0, -1.0], 5.0, cube)) == pytest.approx(1.9, abs=1e-5)
    for y, expected in ((0.24, 1.5), (0.26, math.inf), (-0.26, math.inf)):  # along two pairs of faces
        assert float(one(flat(), (0.0, y, 1.05), [1.0, 0, 0], 5.0, cube)) == pytest.approx(expected, abs=1e-5)
    # Turned by 45 degrees about z its edge points here: at 2 - 0.25 sqrt(2) of a square of 0.25.
    square = box((2.0, 0.0, 1.0), (0.25, 0.25, 0.1), yaw=math.pi / 4)
    expected = 2 - 0.25 * math.sqrt(2)
    assert float(one(flat(), o, [1.0, 0, 0], 5.0, square)) == pytest.approx(expected, abs=1e-5)


def test_nearer_of_box_and_ground_is_hit():
    field, low = flat(), box((1.0, 0.0, 0.1), (0.2, 0.2, 0.1))
    d = [[1.0, 0.0, -1.0], [1.0, 0.0, -0.5], [0.7, 0.0, -1.0]]  # over the box 1 m away, at 0.8..1.2 m and 0..0.2 m
    expected = torch.tensor([0.8 * math.sqrt(2), math.hypot(2.0, 1.0), math.hypot(0.7, 1.0)])
    torch.testing.assert_close(one(field, (0.0, 0.0, 1.0), d, 5.0, low), expected, atol=1e-5, rtol=0)


def test_inside_a_box_everything_is_hit_at_once():
    d, around = unit(np.random.default_rng(0), 20), box((1.1, 1.0, 1.0), (0.5, 0.5, 0.5), yaw=1.0)
    assert torch.equal(one(flat(), (1.0, 1.0, 1.0), d, 5.0, around), torch.zeros(20))


@pytest.mark.parametrize("half_size", [(0.0, 0.5, 0.5), (0.0, 0.0, 0.0), (-1.0, -1.0, -1.0), (0.5, 0.5, math.nan)])
def test_absent_boxes_are_not_there(half_size):
    d = unit(np.random.default_rng(1), 50)
    absent = box((0.5, 0.0, 1.0), half_size)
    assert torch.equal(one(flat(), (0.5, 0.0, 1.0), d, 5.0, absent), one(flat(), (0.5, 0.0, 1.0), d, 5.0))


def test_absent_boxes_may_lack_a_pose():
    d = unit(np.random.default_rng(1), 50)
    absent, there = box((math.nan, 0.0, 1.0), (0.0, 0.0, 0.0)), box((0.5, 0.0, 1.0), (0.1, 0.1, 0.1))
    both = there.joined(absent)
    assert torch.equal(one(flat(), (0.0, 0.0, 1.0), d, 5.0, both), one(flat(), (0.0, 0.0, 1.0), d, 5.0, there))


def slab(T, half, origin, d):
    """Distance to one box by its definition: the first of the entries into its faces' planes that lies on the box."""
    o, d = T[:3, :3].T @ (origin - T[:3, 3]), T[:3, :3].T @ d
    if (abs(o) <= half).all():
        return 0.0
    best = np.inf
    for axis in range(3):
        for side in (-1, 1):
            t = (side * half[axis] - o[axis]) / d[axis]
            at = np.delete(abs(o + t * d) - half, axis)
            if t > 0 and (at <= 1e-9).all():
                best = min(best, t)
    return best


@pytest.mark.slow(1)
@given(st.integers(0, 10_000))
def test_boxes_by_definition(seed):
    rng, B, K, M = np.random.default_rng(seed), 2, 4, 25
    T = np.tile(np.eye(4), (B, K, 1, 1))
    for b, k in np.ndindex(B, K):
        T[b, k, :3, :3], T[b, k, :3, 3] = rotation(*rng.uniform(-3, 3, 3)), rng.uniform(-1, 1, 3) + (0, 0, 3)
    half, origin = rng.uniform(0.05, 0.6, (B, K, 3)), rng.uniform(-2, 2, (B, 3)) + (0, 0, 3)
    aim = T[..., :3, 3][:, rng.integers(K, size=M)] + rng.normal(0, 0.3, (B, M, 3)) - origin[:, None]
    d = aim / np.linalg.norm(aim, axis=-1, keepdims=True)
    boxes = Boxes(torch.from_numpy(T), torch.from_numpy(half))
    tiles = torch.zeros(B, dtype=torch.int64)
    got = cast(flat(-50.0), tiles, torch.from_numpy(origin), torch.from_numpy(d), 20.0, boxes)
    for b, m in np.ndindex(B, M):
        expected = min(slab(T[b, k], half[b, k], origin[b], d[b, m]) for k in range(K))
        clear = all(abs(grown - expected) < 1e-3 or grown == expected for grown in (
            min(slab(T[b, k], half[b, k] + s * 1e-5, origin[b], d[b, m]) for k in range(K)) for s in (-1, 1)
        ))  # fmt: skip
        assert not clear or float(got[b, m]) == pytest.approx(expected, abs=1e-4)


def test_boxes_are_moved_and_joined():
    base = box((1.0, 2.0, 3.0), (1.0, 1.0, 1.0), yaw=0.5)
    leg = box((0.5, 0.0, -0.25), (0.1, 0.1, 0.2), pitch=0.25)
    moved = leg.moved(base.T_map_box[:, 0])
    torch.testing.assert_close(moved.T_map_box[0, 0], base.T_map_box[0, 0] @ leg.T_map_box[0, 0])
    joined = base.joined(moved)
    assert joined.T_map_box.shape == (1, 2, 4, 4) and joined.half_size[0, 1].tolist() == [0.1, 0.1, 0.2]


def on(device, B=2, M=5, K=3):
    """A field, and what `cast` takes with it."""
    field = HeightField(torch.rand(2, 20, 30), 0.05).to(device)
    boxes = Boxes(torch.eye(4).expand(B, K, 4, 4).to(device), torch.full((B, K, 3), 0.1).to(device))
    directions = torch.nn.functional.normalize(torch.rand(B, M, 3) - 0.5, dim=-1).to(device)
    return field, torch.zeros(B, dtype=torch.int64).to(device), torch.rand(B, 3).to(device), directions, 8.0, boxes


@pytest.mark.slow(1)
def test_host_reads_nothing_back():
    inputs = on("meta")
    with OneDevice(), NoConstants():
        assert cast(*inputs).shape == (2, 5)


@pytest.mark.slow(1)
def test_path_of_a_gpu_has_static_shapes(monkeypatch):
    never_wait(monkeypatch)
    field, *inputs, reach, boxes = on("cpu")
    with FakeTensorMode(allow_non_fake_inputs=True) as mode:
        boxes = Boxes(*(mode.from_tensor(v) for v in boxes))
        assert cast(field, *(mode.from_tensor(v) for v in inputs), reach, boxes).shape == (2, 5)


@pytest.mark.parametrize("seed", range(5))
def test_boxes_equal_those_of_the_tensors(seed, monkeypatch):
    torch.manual_seed(seed)
    field, *inputs = on("cpu", B=3, M=300, K=5)
    inputs[-1].half_size[:, 1] = 0.0
    fast = cast(field, *inputs)
    monkeypatch.setenv("TORCHELEV_NATIVE", "0")
    same(fast, cast(field, *inputs))


def test_rays_along_a_face_of_a_box_miss_it(path):
    for axis, side in ((0, 0.5), (1, 0.25), (2, 0.1)):
        origin, d = torch.tensor([2.0, 0.0, 1.0]), torch.zeros(3)
        origin[axis] += side
        origin[(axis + 1) % 3] -= 1.0
        d[(axis + 1) % 3] = 1.0
        assert one(flat(-9.0), tuple(origin.tolist()), d, 3.0, box((2.0, 0.0, 1.0), (0.5, 0.25, 0.1))).isinf().all()


@pytest.mark.parametrize("dtype", [torch.float64, torch.float16])
def test_default_dtype_and_device_change_nothing(dtype):
    field, *inputs = on("cpu")
    expected = cast(field, *inputs)
    torch.set_default_dtype(dtype)
    try:
        with torch.device("meta"):
            assert torch.equal(cast(field, *inputs), expected)
    finally:
        torch.set_default_dtype(torch.float32)


def test_within_transforms():
    field, *inputs = on("cpu")
    total = cast(field, *inputs).nan_to_num(0.0, 0.0, 0.0).sum()
    gradient = torch.func.grad(lambda x: cast(field, *inputs).nan_to_num(0.0, 0.0, 0.0).sum() * x)(torch.tensor(1.0))
    torch.testing.assert_close(gradient, total)


def test_far_beyond_the_rim(path):
    field = flat()
    for x in (1e5, 1e6, 1e8):
        t = one(field, (x, 0.0, 1.0), [[0.6, 0.0, -0.8], [0.0, 0.0, -1.0], [0.0, 0.6, -0.8]], 5.0)
        same(t, torch.tensor([1.25, 1.0, 1.25]))


@needs_gpu
def test_gpu_equals_cpu():
    torch.manual_seed(0)
    field, *inputs = on("cpu", B=2, M=400)
    expected = cast(field, *inputs)
    moved = [v.cuda() if isinstance(v, torch.Tensor) else v for v in inputs[:-1]]
    boxes, field = Boxes(*(v.cuda() for v in inputs[-1])), field.to("cuda")
    cast(field, *moved, boxes)
    torch.cuda.set_sync_debug_mode("error")
    try:
        got = cast(field, *moved, boxes)
    finally:
        torch.cuda.set_sync_debug_mode("default")
    same(got.cpu(), expected, 1e-4)


def test_origin_that_is_not_finite_hits_nothing(path):
    field, tiles, origin, d, reach, _ = on("cpu")
    clean = cast(field, tiles, origin, d, reach)
    origin[0, 1] = math.nan
    t = cast(field, tiles, origin, d, reach)
    assert t[0].isinf().all()
    same(t[1], clean[1])


def test_takes_inputs_of_any_precision_and_leaves_them_alone():
    field, tiles, origin, d, reach, boxes = on("cpu")
    before = [origin.clone(), d.clone(), boxes.T_map_box.clone(), boxes.half_size.clone(), field.padded.clone()]
    doubled = Boxes(boxes.T_map_box.double(), boxes.half_size.double())
    t = cast(field, tiles, origin.double(), d.double(), reach, doubled)
    assert t.dtype == torch.float32 and torch.equal(t, cast(field, tiles, origin, d, reach, boxes))
    after = [origin, d, boxes.T_map_box, boxes.half_size, field.padded]
    assert all(torch.equal(a, b) for a, b in zip(before, after, strict=True))


def test_no_rays_no_environments_no_boxes():
    field, tiles, origin, d, reach, boxes = on("cpu")
    assert cast(field, tiles, origin, d[:, :0], reach).shape == (2, 0)
    assert cast(field, tiles[:0], origin[:0], d[:0], reach).shape == (0, 5)
    none = Boxes(boxes.T_map_box[:, :0], boxes.half_size[:, :0])
    assert torch.equal(cast(field, tiles, origin, d, reach, none), cast(field, tiles, origin, d, reach))


@pytest.mark.parametrize(
    "change, text",
    [
        (dict(origin=torch.zeros(3, 3)), "origin, directions"),
        (dict(directions=torch.zeros(2, 3)), "origin, directions"),
        (dict(directions=torch.zeros(1, 5, 3)), "origin, directions"),
        (dict(max_range=0.0), "max_range"),
        (dict(max_range=math.inf), "max_range"),
        (dict(tile_ids=torch.tensor([0, 2])), "tile_ids"),
        (dict(tile_ids=torch.tensor([-1, 0])), "tile_ids"),
        (dict(tile_ids=torch.tensor([0, 1], dtype=torch.int32)), "tile_ids: must be int64"),
        (dict(origin=torch.zeros(2, 3, device="meta")), "must be on cpu"),
        (dict(boxes=Boxes(torch.eye(4).expand(1, 3, 4, 4), torch.ones(1, 3, 3))), "boxes"),
        (dict(boxes=Boxes(torch.eye(4).expand(2, 4, 4), torch.ones(2, 3))), "boxes"),
    ],
)
def test_refuses(change, text):
    error = TypeError if "must be int64" in text else ValueError
    names = ("field", "tile_ids", "origin", "directions", "max_range", "boxes")
    with pytest.raises(error, match=text):
        cast(**{**dict(zip(names, on("cpu"), strict=True)), **change})
