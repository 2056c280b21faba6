"""Points at a sensor's limit and on its own path are named; rings, round rooms and walls that look alike are not."""

import numpy as np
import pytest
import torch

from torchelev import ElevationMap, ElevationMapConfig, GridConfig, SensorConfig
from torchelev.sim import DepthCamera, Lidar, mount

CFG = ElevationMapConfig(grid=GridConfig(resolution=0.1, length_x=8.0, length_y=8.0))
LIMIT = 2.6  # [m]
CAMERA, LIDAR = (
    DepthCamera(width=64, height=48).directions.numpy(),
    Lidar(32, 128, fov_high_deg=20.0).directions.numpy(),
)
FORWARD, OPTICAL = np.eye(3), np.array([[0.0, -1, 0], [0, 0, -1], [1, 0, 0]])  # axes of the points


def places(moving=True):
    """T_map_sensor (4, 4) of a robot that drives ahead and turns, its sensor 0.5 m above the ground and level."""
    for k in range(8):
        T = np.eye(4)
        yaw = 0.05 * k * moving
        T[:2, :2] = [[np.cos(yaw), -np.sin(yaw)], [np.sin(yaw), np.cos(yaw)]]
        T[:3, 3] = 0.1 * k * moving, 0.0, 0.5
        yield T


def diagnose(scan, poses, cfg=CFG, axes=FORWARD, dtype=torch.float32):
    """Diagnose a map of the clouds `scan(T)`, in the sensor's axes x forward, y left, z up."""
    emap, turn = ElevationMap(cfg), np.eye(4)
    turn[:3, :3] = axes.T
    for T in poses:
        points = torch.from_numpy(scan(T) @ axes.T).to(dtype)
        emap.update(points[None], torch.from_numpy(T @ turn)[None], torch.from_numpy(T)[None], dt=0.1)
    return emap.diagnose()


def ranges(T, directions, ground=0.0, wall=np.inf):
    """Return how far rays (N, 3) go to flat ground or a wall at x = `wall`; inf where they meet neither."""
    rays = directions @ T[:3, :3].T
    with np.errstate(divide="ignore", invalid="ignore"):
        down, ahead = (ground - T[2, 3]) / rays[:, 2], (wall - T[0, 3]) / rays[:, 0]
    return np.minimum(np.where(down > 0, down, np.inf), np.where(ahead > 0, ahead, np.inf))


def pitched(T, degrees=20.0):
    return T @ mount(degrees).numpy()


def clamp(directions, **world):
    """A sensor that returns points at its limit where it sees nothing nearer."""
    return lambda T: directions * np.minimum(ranges(T, directions, **world), LIMIT)[:, None]


def clamp_depth(directions, **world):
    """A depth image whose far plane is its limit."""
    return lambda T: directions * np.minimum(ranges(T, directions, **world), LIMIT / directions[:, 0])[:, None]


def exact(directions, reach=50.0, **world):
    def scan(T):
        r = ranges(T, directions, **world)
        return directions * np.where(r < reach, r, np.nan)[:, None]

    return scan


@pytest.mark.slow(1)
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64, torch.float16])
@pytest.mark.parametrize("moving", [True, False])
@pytest.mark.parametrize("directions", [CAMERA, LIDAR], ids=["camera", "lidar"])
def test_a_range_that_many_points_share_is_named(directions, moving, dtype):
    """MuJoCo's cutoff clamps."""
    sentence, *_ = diagnose(clamp(directions), [pitched(T) for T in places(moving)], dtype=dtype)
    share = np.mean(ranges(pitched(next(places())), directions) > LIMIT)
    assert sentence.startswith(f"points: {100 * share:.0f} % of the points share one range of 2.60 m")


def test_a_limit_is_that_of_one_sensor_of_two():
    emap, near, far = ElevationMap(CFG), exact(CAMERA), clamp(CAMERA)
    for T in places():
        both = torch.from_numpy(np.stack([near(pitched(T)), far(pitched(T))])).float()
        pose = torch.from_numpy(pitched(T))
        emap.update(both[None], pose.expand(1, 2, 4, 4), torch.from_numpy(T)[None], dt=0.1)
    assert any("share one range of 2.60 m" in text for text in emap.diagnose())


def test_a_plane_scanner_that_moves_with_its_limit_is_named():
    fan = Lidar(1, 360, fov_low_deg=0.0, fov_high_deg=0.0).directions.numpy()
    assert "share one range of 2.60 m" in diagnose(clamp(fan, wall=2.9), places())[0]


@pytest.mark.parametrize("axes", [FORWARD, OPTICAL], ids=["forward", "optical"])
def test_a_depth_that_many_points_share_is_named(axes):
    """The depth image of a renderer holds its far plane."""
    scan = clamp_depth(CAMERA)
    sentence, *_ = diagnose(scan, [pitched(T) for T in places()], axes=axes)
    share = np.mean(np.isclose(scan(pitched(next(places())))[:, 0], LIMIT))
    assert sentence.startswith(f"points: {100 * share:.0f} % of the points share one depth of 2.60 m")


def sphere(T):
    return 3.0 * LIDAR


def cylinder(T):
    lidar = Lidar(16, 128, fov_low_deg=-15.0, fov_high_deg=15.0).directions.numpy()
    return lidar * (3.0 / np.linalg.norm(lidar[:, :2], axis=1))[:, None]


SOUND = {
    "lidar over flat ground": (exact(LIDAR), True),
    "lidar over flat ground, still": (exact(LIDAR), False),
    "camera over flat ground": (exact(CAMERA), True),
    "camera that looks down": (exact(CAMERA), True),
    "lidar in a round room": (cylinder, False),
    "lidar in a sphere": (sphere, False),
    "camera before a wall": (exact(CAMERA, wall=3.0), False),
    "camera that drives at a wall": (exact(CAMERA, wall=3.0), True),
    "camera whose image ends at a range": (exact(CAMERA, reach=LIMIT), True),
}


@pytest.mark.slow(1)
@pytest.mark.parametrize("name", SOUND)
def test_surfaces_of_one_range_or_depth_are_none(name):
    scan, moving = SOUND[name]
    poses = [pitched(T, 90.0) if "down" in name else T for T in places(moving)]
    assert [text for text in diagnose(scan, poses) if "share one" in text] == []


def test_a_camera_along_a_wall_sees_one_depth():
    """It drives to its left: the wall stays at one depth and where it is."""
    poses = [np.array([[1.0, 0, 0, 0], [0, 1, 0, 0.1 * k], [0, 0, 1, 0.5], [0, 0, 0, 1]]) for k in range(8)]
    assert [text for text in diagnose(exact(CAMERA, wall=3.0), poses) if "share one" in text] == []


def test_a_limit_that_the_gate_rejects_is_harmless():
    cfg = ElevationMapConfig(grid=CFG.grid, sensor=SensorConfig(max_distance=LIMIT - 0.01))
    assert diagnose(clamp(CAMERA), [pitched(T) for T in places()], cfg) == []


def places_within_the_scan(number=400):
    """Missing returns of a cloud whose motion was taken out: where the sensor was, in its frame."""
    return np.linspace(-0.5, 0.5, number)[:, None] * [1.0, 0.0, 0.0]


def drive(height=0.5):
    for k in range(8):
        T = np.eye(4)
        T[:3, 3] = k, 0.0, height
        yield T


def test_points_on_the_sensors_own_path_are_named():
    sentence, *_ = diagnose(lambda T: np.vstack([exact(LIDAR)(T), places_within_the_scan()]), drive())
    assert sentence.startswith("points: ") and "lie on the sensor's own path" in sentence
    assert diagnose(exact(LIDAR), drive()) == []


@pytest.mark.slow(1)
def test_ground_below_a_frame_on_the_ground_is_no_path():
    """The cloud was taken into base_footprint before: its frame moves along the ground."""
    xy = np.random.default_rng(0).uniform(-3, 3, (20_000, 2))
    ground = np.column_stack([xy, np.zeros(len(xy))])
    assert [text for text in diagnose(lambda T: ground, drive(height=0.0)) if "own path" in text] == []
