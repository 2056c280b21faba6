"""Ray casting against closed forms."""

import math

import pytest
import torch

from torchelev.sim import Box, DepthCamera, Lidar, Scene, cast, turn_on_the_spot
from torchelev.sim.exact import scenes

CAMERA = DepthCamera(width=40, height=30)
TENTH = 1e-4  # [m]


def seen(scene, sensor=CAMERA, height=0.8, t=0.0):
    """Return the points in the map frame, and whether each ray hit."""
    T = turn_on_the_spot(height, n=7, scene=scene).T_map_sensor[1]
    points = sensor.cast(scene, T, t).double() @ T[:3, :3].T + T[:3, 3]
    return points, points.isfinite().all(-1), T


def test_directions_are_unit_and_span_the_view():
    d = DepthCamera().directions
    assert d.shape == (19200, 3)
    torch.testing.assert_close(d.norm(dim=-1), torch.ones(19200, dtype=torch.float64))
    widest = torch.atan2(d[:, 1], d[:, 0]).max().rad2deg()
    assert 42.5 < float(widest) < 43.0
    assert Lidar().directions.shape == (32 * 1024, 3)


def test_flat_ground():
    points, hit, T = seen(scenes.flat())
    down = CAMERA.directions @ T[:3, :3].T
    expected = -T[2, 3] / down[:, 2]
    expected = torch.where((expected > 0) & (expected <= CAMERA.max_range), expected, math.nan)
    distance = (points - T[:3, 3]).norm(dim=-1)
    torch.testing.assert_close(distance, expected, atol=TENTH, rtol=0, equal_nan=True)


@pytest.mark.parametrize("sensor", [CAMERA, Lidar(rings=8, azimuths=64)], ids=["camera", "lidar"])
@pytest.mark.parametrize("scene", [scenes.slope(), scenes.rough(3)], ids=lambda scene: scene.name)
def test_hits_lie_on_the_terrain(scene, sensor):
    points, hit, _ = seen(scene, sensor)
    assert hit.float().mean() > 0.4
    torch.testing.assert_close(points[hit, 2], scene.truth(points[hit, :2]), atol=TENTH, rtol=0)


def test_terrain_hit_is_the_first():
    scene = scenes.rough(3)
    points, hit, T = seen(scene)
    for share in torch.linspace(0.05, 0.99, 40):
        before = T[:3, 3] + share * (points[hit] - T[:3, 3])
        assert bool((before[:, 2] > scene.truth(before[:, :2])).all())


def test_vertical_faces_are_hit_on_the_face():
    face = 1.217
    scene = Scene(boxes=(scenes.block(face, 3.0, -5.0, 5.0, 0.5),))
    T = turn_on_the_spot(n=4).T_map_sensor[0]
    points = CAMERA.cast(scene, T).double() @ T[:3, :3].T + T[:3, 3]
    on_face = (points[:, 2] > 1e-3) & (points[:, 2] < 0.5 - 1e-3)
    assert int(on_face.sum()) > 50
    assert float((points[on_face, 0] - face).abs().max()) < TENTH
    on_top = points[:, 0] > face + 1e-3
    assert float((points[on_top, 2] - 0.5).abs().max()) < TENTH


def test_boxes_against_marching():
    scene = scenes.boxes(1)
    points, hit, T = seen(scene)
    for share in torch.linspace(0.02, 0.999, 200):
        before = T[:3, 3] + share * (points[hit] - T[:3, 3])
        assert bool((before[:, 2] >= scene.truth(before[:, :2]) - 1e-9).all())
    inside = points[hit] + 1e-3 * torch.nn.functional.normalize(points[hit] - T[:3, 3], dim=-1)
    # 1 mm farther along the ray lies in something, but for rays that cut an edge.
    assert (inside[:, 2] < scene.truth(inside[:, :2])).double().mean() > 0.99


def test_single_box_distance_and_miss():
    scene = Scene(boxes=(Box(low=(2.0, -0.5, 0.5), high=(2.4, 0.5, 1.5)),))
    rays = torch.tensor([[1.0, 0, 0], [0, 1.0, 0], [-1.0, 0, 0]], dtype=torch.float64)
    distance = cast(scene, torch.tensor([0.0, 0.0, 1.0], dtype=torch.float64), rays, 10.0)
    torch.testing.assert_close(distance, torch.tensor([2.0, math.nan, math.nan], dtype=torch.float64), equal_nan=True)


def test_person_hides_the_ground_until_gone():
    scene = scenes.person(until=1.0)
    T = turn_on_the_spot(n=4).T_map_sensor[0]
    before, after = CAMERA.cast(scene, T, 0.5), CAMERA.cast(scene, T, 1.0)
    flat = CAMERA.cast(scenes.flat(), T)
    torch.testing.assert_close(after, flat, equal_nan=True)
    assert int((before.norm(dim=-1) < flat.norm(dim=-1) - 0.1).sum()) > 20


def test_nothing_beyond_the_range():
    points = DepthCamera(width=40, height=30, max_range=2.0).cast(scenes.flat(), turn_on_the_spot().T_map_sensor[0])
    d = points.norm(dim=-1)
    assert bool(d.isnan().any()) and float(d[d.isfinite()].max()) <= 2.0
