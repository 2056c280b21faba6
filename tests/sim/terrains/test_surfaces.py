"""The triangles of a height field's cells, by hand and against MuJoCo's rays and contacts."""

import numpy as np
import pytest
import torch

from torchelev.sim import HeightField, make_terrain, surface_of
from torchelev.sim.sensors.casting import cast
from torchelev.sim.terrains.shapes import SHAPES

mujoco = pytest.importorskip("mujoco")

# One cell of 1 m, whose corners are 0 but for one of 1 m at x = y = 0.5.
CORNER = torch.tensor([[[0.0, 0.0], [0.0, 1.0]]])


@pytest.mark.parametrize(
    "surface, diagonal, expected",
    [
        ("bilinear", "rising", (0.1875, 0.25, 0.5625)),  # u v
        ("triangles", "rising", (0.25, 0.5, 0.75)),  # the lower one of u and v
        ("triangles", "falling", (0.0, 0.0, 0.5)),  # u + v - 1 beyond the diagonal
    ],
)
def test_triangles_by_hand(surface, diagonal, expected):
    field, xy = HeightField(CORNER, 1.0, surface, diagonal), torch.tensor([[-0.25, 0.25], [0.0, 0.0], [0.25, 0.25]])
    zeros = torch.zeros(1, dtype=torch.int64)
    torch.testing.assert_close(field.height(zeros, xy[None])[0], torch.tensor(expected))
    again = HeightField(CORNER, 1.0).with_surface(surface, diagonal)
    torch.testing.assert_close(again.height(zeros, xy[None])[0], torch.tensor(expected))
    down = torch.tensor([[[0.0, 0.0, -1.0]]]).expand(3, 1, 3)
    origin = torch.cat([xy, torch.full((3, 1), 2.0)], 1)
    distance = cast(field, zeros.expand(3).contiguous(), origin, down, 5.0)[:, 0]
    torch.testing.assert_close(2.0 - distance, torch.tensor(expected))


def scene(heights, resolution):
    """Return a MuJoCo model of heights (H, W) [m], x along rows, with a small ball, and its data."""
    low, relief = float(heights.min()), max(float(np.ptp(heights)), 1e-3)
    size = [*(resolution * (n - 1) / 2 for n in heights.shape), relief, 1.0]
    spec = mujoco.MjSpec()
    rows = ((heights - low) / relief).T
    spec.add_hfield(name="ground", nrow=rows.shape[0], ncol=rows.shape[1], size=size, userdata=rows.flatten().tolist())
    hfield = mujoco.mjtGeom.mjGEOM_HFIELD
    spec.worldbody.add_geom(name="ground", type=hfield, hfieldname="ground", pos=[0, 0, low], group=0)
    ball = spec.worldbody.add_body(name="ball", pos=[0, 0, 50])
    ball.add_freejoint()
    ball.add_geom(type=mujoco.mjtGeom.mjGEOM_SPHERE, size=[1e-4, 0, 0], mass=1.0, group=1)
    model = spec.compile()
    return model, mujoco.MjData(model)


def cast_by_mujoco(model, data, origin, directions):
    mujoco.mj_forward(model, data)
    geom, distance = np.zeros(len(directions), np.int32), np.zeros(len(directions))
    ground = np.array([1, 0, 0, 0, 0, 0], np.uint8)
    rays = directions.ravel().astype(float)
    mujoco.mj_multiRay(model, data, origin, rays, ground, 1, -1, geom, distance, None, len(directions), 20.0)
    return np.where(geom < 0, np.inf, distance)


@pytest.mark.parametrize("kind", SHAPES)
def test_heights_and_rays_are_mujocos(kind):
    terrain = make_terrain(kind, torch.tensor([0.7]), length=6.0, resolution=0.05, seed=3)
    field, zeros = terrain.field.with_surface(**surface_of("mujoco")), torch.zeros(1, dtype=torch.int64)
    model, data = scene(field.heights[0].double().numpy(), field.resolution)
    rng = np.random.default_rng(0)
    for _ in range(4):
        origin = np.array([*rng.uniform(-1.5, 1.5, 2), 2.0])
        d = rng.normal(size=(300, 3))
        d[:, 2] = -abs(d[:, 2])
        d[:20] = (0, 0, -1)
        d /= np.linalg.norm(d, axis=1, keepdims=True)
        expected = cast_by_mujoco(model, data, origin, d)
        start, directions = torch.from_numpy(origin)[None].float(), torch.from_numpy(d)[None].float()
        got = cast(field, zeros, start, directions, 20.0)[0].numpy()
        hits = origin + np.where(np.isfinite(expected), expected, 0.0)[:, None] * d
        inside = np.isfinite(expected) & (abs(hits[:, :2]).max(1) < 2.99)  # MuJoCo's ground ends at the rim
        assert inside.sum() > 100
        assert abs(got[inside] - expected[inside]).max() < 1e-3
        height = field.height(zeros, torch.from_numpy(hits[inside, :2])[None])[0].numpy()
        steepest = field.heights.diff(dim=1).abs().max().item() / field.resolution
        assert abs(height - hits[inside, 2]).max() < 1e-3 + 1e-4 * steepest


@pytest.mark.parametrize("kind", ["boxes", "stepping_stones"])
def test_feet_stand_on_it(kind):
    """A ball of 0.1 mm first touches MuJoCo's ground at the height of the triangles."""
    terrain = make_terrain(kind, torch.tensor([0.7]), length=4.0, resolution=0.05, seed=3)
    field, zeros = terrain.field.with_surface(**surface_of("mujoco")), torch.zeros(1, dtype=torch.int64)
    model, data = scene(field.heights[0].double().numpy(), field.resolution)
    xy = np.random.default_rng(1).uniform(-1.9, 1.9, (6000, 2))
    heights = field.height(zeros, torch.from_numpy(xy)[None])[0].double().numpy()
    bilinear = terrain.field.height(zeros, torch.from_numpy(xy)[None])[0].double().numpy()
    chosen = np.argsort(-abs(heights - bilinear))[:25]  # where it matters most
    assert abs(heights - bilinear)[chosen].min() > 0.01
    for (x, y), z in zip(xy[chosen], heights[chosen], strict=True):
        touches = [touch(model, data, x, y, z + over) for over in (-0.001, 0.003)]
        assert touches == [True, False]


def touch(model, data, x, y, z):
    data.qpos[:3] = x, y, z
    mujoco.mj_forward(model, data)
    return data.ncon > 0


def test_refuses_what_there_is_not():
    with pytest.raises(ValueError, match="surface: must be bilinear or triangles, got 'flat'"):
        HeightField(CORNER, 1.0, "flat")
    with pytest.raises(ValueError, match="diagonal: must be rising or falling, got 'up'"):
        HeightField(CORNER, 1.0).with_surface("triangles", "up")
    with pytest.raises(ValueError, match="engine: must be one of mujoco"):
        surface_of("bullet")
