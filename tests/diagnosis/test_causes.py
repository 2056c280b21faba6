"""`diagnose` names each usual mistake on simulated scans that provoke it, and is silent on sound ones."""

import copy
import dataclasses
import os

import pytest
import torch
from torch import Tensor

from tests.diagnosis.walks import CFG, DT, SENSORS, map_of, on_reordered_base, reordered, sound_scene
from tests.helpers import nans, pose, small_map
from torchelev import Capsule, ElevationMap, ElevationMapConfig, RobotBody, SensorConfig
from torchelev.sim import mount, range_noise, walk
from torchelev.sim.exact import scenes as library

OPTICAL = torch.tensor([[0.0, 0, 1, 0], [-1, 0, 0, 0], [0, -1, 0, 0], [0, 0, 0, 1]]).double()
FLIP = torch.diag(torch.tensor([1.0, -1, -1, 1])).double()


def move(T: Tensor, points: Tensor) -> Tensor:
    return (points.double() @ T[..., :3, :3].mT + T[..., None, :3, 3]).float()


@pytest.fixture(scope="module", params=SENSORS)
def walked(request):
    """Scans (points, T_map_sensor, T_map_base) of a walk over rough ground towards stairs, with a turn."""
    scene, (sensor, pitch) = library.mixed(0), SENSORS[request.param]
    route = [(-2.6, 0.05), (0.6, 0.05), (0.6, -0.6)]
    path = walk(scene, route, dt=DT, T_base_sensor=mount(pitch))
    steps = range(0, 24)
    return [(sensor.cast(scene, path.T_map_sensor[k])[None], path.T_map_sensor[k, None], path.T_map_base[k, None])
            for k in steps]  # fmt: skip


def shift(axis, length):
    """What to add to poses to move them along an axis of the map [m]."""
    change = torch.zeros(4, 4)
    change[axis, 3] = length
    return change


def transposed(T):
    T = T.clone()
    T[..., :3, :3] = T[..., :3, :3].mT.clone()
    return T


def with_legs(points, T, base):
    """60 points on a leg that moves with the base."""
    spread = torch.rand(1, 60, 3, generator=torch.Generator().manual_seed(0)) * torch.tensor([0.06, 0.06, 0.3])
    leg = move(torch.linalg.inv(T) @ base, spread + torch.tensor([0.2, 0.15, -0.35]))
    return torch.cat([points, leg], 1), T, base


def mounting(T, base):
    """Return the rotation (1, 4, 4) of the sensor on its base."""
    M = torch.linalg.inv(base) @ T
    M[..., :3, 3] = 0.0
    return M


MISTAKES = {
    "in the map frame already": lambda p, T, base: (move(T, p), T, base),
    "millimetres": lambda p, T, base: (1000 * p, T, base),
    "the points have optical axes": lambda p, T, base: (move(OPTICAL.T, p), T, base),
    "the pose has optical axes": lambda p, T, base: (p, T @ OPTICAL, base),
    "is inverted": lambda p, T, base: (p, torch.linalg.inv(T), base),
    "rotation in T_map_sensor is transposed": lambda p, T, base: (p, transposed(T), base),
    "order w x y z was read as x y z w": lambda p, T, base: (p, reordered(T, 1), base),
    "order x y z w was read as w x y z": lambda p, T, base: (p, reordered(T, -1), base),
    "the base's quaternion, in the order w x y z, was read as x y z w": on_reordered_base(1),
    "the base's quaternion, in the order x y z w, was read as w x y z": on_reordered_base(-1),
    "upside down": lambda p, T, base: (move(FLIP, p), T, base),
    "own legs": with_legs,
    "give T_map_base, which the window follows": lambda p, T, base: (p, T + shift(0, 50.0), None),
    "check T_map_base": lambda p, T, base: (p, T, base + shift(0, 50.0)),
    "the sensor moves by": lambda p, T, base: (p, T, torch.linalg.inv(base)),
    "is the identity": lambda p, T, base: (move(T, p), torch.eye(4, dtype=torch.float64)[None], base),
    "m against the base": lambda p, T, base: (p, T, torch.eye(4, dtype=torch.float64)[None]),
}


@pytest.mark.slow(10)
@pytest.mark.parametrize("words", MISTAKES)
def test_a_mistake_is_named_first(walked, words):
    sentences = map_of(walked, MISTAKES[words]).diagnose()
    assert sentences and words in sentences[0], sentences


@pytest.mark.slow(1)
def test_sound_scans_are_passed_over(walked):
    assert map_of(walked).diagnose() == []
    assert map_of(walked[:1]).diagnose() == []
    assert map_of([(p, T, None) for p, T, _ in walked]).diagnose() == []


@pytest.mark.slow(1)
def test_dt_in_milliseconds(walked):
    for dt in (1000 * DT, 33.0):
        (sentence,) = map_of(walked, dt=dt).diagnose()
        assert sentence.startswith(f"dt: {dt:g} s") and "not ms" in sentence
    assert "dt" in map_of(walked[:1] * 3, dt=100.0).diagnose()[0], "who stands still"


@pytest.mark.slow(1)
def test_legs_that_are_left_by_a_filter_are_blamed_on_its_poses(walked):
    leg = Capsule(link="leg", start=(0, 0, 0), end=(0, 0, 0.3), radius=0.06)
    emap = ElevationMap(dataclasses.replace(CFG, sensor=SensorConfig(body=RobotBody(capsules=(leg,)))))
    for scan in walked:
        emap.update(*with_legs(*scan), dt=DT, T_base_links=pose((0.9, 0.0, 0.0))[:, None])
    (sentence,) = emap.diagnose()
    assert "own legs" in sentence and "check T_base_links" in sentence


SILENT_GATES = {
    "sensor.min_distance": dict(sensor=dict(min_distance=30.0)),
    "sensor.exclusion": dict(sensor=dict(exclusion=dict(offset=-9.0, height=-8.0))),
    "sensor.body": dict(sensor=dict(body=dict(lower=[-20, -20, -20], upper=[20, 20, 20]))),
    "overlap.height": dict(overlap=dict(height=0.2)),
}


@pytest.mark.slow(4)
@pytest.mark.parametrize("setting", SILENT_GATES)
def test_a_gate_that_takes_everything_is_named(walked, setting):
    stages = SILENT_GATES[setting] | {"grid": dict(resolution=0.08, length_x=8.0, length_y=8.0)}
    below = [(p, T, base + shift(2, -1.5)) for p, T, base in walked]  # the ground seems to be a floor above
    scans = below if setting.startswith("overlap") else walked
    sentences = map_of(scans, cfg=ElevationMapConfig.from_dict(stages)).diagnose()
    assert any(setting in sentence for sentence in sentences), sentences


@pytest.mark.slow(1)
def test_no_time_between_updates(walked):
    (sentence,) = map_of(walked, dt=0.0).diagnose()
    assert sentence.startswith("dt: 0 s in all updates")
    emap = ElevationMap(CFG)  # two sensors that take turns: the second is of the same instant
    for points, T, base in walked:
        emap.update(points, T, base, dt=DT)
        emap.update(points, T, base, dt=0.0)
    assert emap.diagnose() == []


@pytest.mark.slow(1)
@pytest.mark.parametrize("knows_base", [True, False])
@pytest.mark.parametrize("height", [0.15, 0.25, 0.35])
@pytest.mark.parametrize("slope", [0.0, 0.4])
def test_the_ground_under_a_low_robot_is_no_leg(knows_base, height, slope):
    """Its base rides so low over the ground that this lies where the legs of others are."""
    emap, generator = ElevationMap(CFG), torch.Generator().manual_seed(0)
    for k in range(20):
        T = torch.eye(4, dtype=torch.float64)[None]
        T[0, 0, 3], T[0, 2, 3] = 0.1 * k, height + slope * 0.1 * k
        xy = 6 * torch.rand(1, 6000, 2, generator=generator) - 3
        z = slope * xy[..., :1] - height + 0.01 * torch.randn(1, 6000, 1, generator=generator)
        emap.update(torch.cat([xy, z], -1), T, T if knows_base else None, dt=0.1)
    assert [text for text in emap.diagnose() if "legs" in text] == []


def test_clouds_without_a_number(walked):
    (sentence,) = map_of(walked, lambda p, T, base: (p * torch.nan, T, base)).diagnose()
    assert "NaN or infinite" in sentence


def test_scans_that_contradict_each_other():
    """Every other scan is higher by a metre than its pose says."""
    ground = torch.rand(1, 4000, 3, generator=torch.Generator().manual_seed(0)) * torch.tensor([6.0, 6.0, 0.0]) - 3.0
    emap = ElevationMap(CFG)
    for k in range(4):
        T = torch.eye(4)[None].clone()
        T[0, 2, 3] = 3.0 + k % 2
        emap.update(ground, T, dt=0.1)
    assert "contradict the map" in emap.diagnose()[-1]


def test_nothing_is_said_of_what_was_not_seen():
    emap = small_map(2)
    assert emap.diagnose() == []
    emap.update(nans(2), torch.eye(4).repeat(2, 1, 1), dt=0.0)
    assert emap.diagnose() == []


def test_reset_forgets_what_was_seen(walked):
    emap = map_of(walked, MISTAKES["millimetres"])
    assert emap.diagnose()
    emap.reset()
    assert emap.diagnose() == []


@pytest.mark.parametrize("how", ["mask", "env_ids"])
def test_a_reset_of_some_forgets_theirs_alone(walked, how):
    emap = ElevationMap(CFG, num_envs=2)
    p, T, base = walked[0]
    emap.update(torch.cat([p, 1000 * p]), T.repeat(2, 1, 1), base.repeat(2, 1, 1), dt=DT)
    for env, found in ((0, True), (1, False)):
        emap.reset(**{how: torch.tensor([env]) if how == "env_ids" else torch.arange(2) == env})
        assert bool(emap.diagnose()) == found


def test_second_environment_is_looked_at(walked):
    emap = ElevationMap(CFG, num_envs=2)
    for p, T, base in walked[:3]:
        emap.update(torch.cat([p, 1000 * p]), T.repeat(2, 1, 1), base.repeat(2, 1, 1), dt=DT)
    assert "millimetres" in emap.diagnose()[0]


def test_inputs_are_copied_and_maps_too(walked):
    """A caller may reuse its tensors; deepcopy and inference mode go on, and the state is what it was."""
    p, T, base = walked[0]
    emap, names = ElevationMap(CFG), set(ElevationMap(CFG).state_dict())
    with torch.inference_mode():
        buffer = 1000 * p
        emap.update(buffer, T, base, dt=DT)
        buffer.zero_()
    assert "millimetres" in emap.diagnose()[0]
    assert "millimetres" in copy.deepcopy(emap).diagnose()[0]
    assert set(emap.state_dict()) == names
    twin = ElevationMap(CFG)
    twin.update(p.clone().requires_grad_(), T, base, dt=DT)
    copy.deepcopy(twin)


@pytest.mark.slow(9)
@pytest.mark.parametrize("seed", range(int(os.environ.get("SOUND_SCENES", 12))))
def test_random_sound_scenes_are_passed_over(seed):
    """SOUND_SCENES=100 in the environment tries more."""
    scene, sensor, path, cfg, knows_base = sound_scene(seed)
    generator, emap = torch.Generator().manual_seed(seed), ElevationMap(cfg)
    for k in range(min(12, len(path.times))):
        points = range_noise(sensor.cast(scene, path.T_map_sensor[k], float(path.times[k])), generator)
        base = path.T_map_base[k, None] if knows_base else None
        emap.update(points[None], path.T_map_sensor[k, None], base, dt=DT)
    assert emap.diagnose() == []


TWICE = {
    "as the points have the axes of the base already": lambda p, T, base: (move(mounting(T, base), p), T, base),
    "is applied twice in T_map_sensor": lambda p, T, base: (p, T @ mounting(T, base), base),
}


@pytest.mark.slow(1)
@pytest.mark.parametrize("words", TWICE)
@pytest.mark.parametrize("num_scans", [1, 12])
@pytest.mark.parametrize("pitch", [12.0, 20.0, 35.0])
def test_a_mounting_that_is_applied_twice_is_named(words, pitch, num_scans):
    """The ground is tilted by no more than a hill would be, but moves with the robot."""
    scene, camera = library.flat(), SENSORS["camera"][0]
    path = walk(scene, [(-1.0, 0.0), (1.0, 0.0)], dt=DT, T_base_sensor=mount(pitch), sway=0.0)
    poses = list(zip(path.T_map_sensor, path.T_map_base, strict=True))[:num_scans]
    scans = [(camera.cast(scene, T)[None], T[None], base[None]) for T, base in poses]
    assert map_of(scans).diagnose() == []
    first, *_ = map_of(scans, TWICE[words]).diagnose()
    assert words in first and sum(other in first for other in TWICE) == 1


GRID = torch.tensor([603412.0, 187250.0, 940.0], dtype=torch.float64)  # [m] a place in a national grid


def test_points_in_a_national_grid_are_not_in_millimetres(walked):
    """They lie far away but close together."""
    points, T, base = walked[0]
    (sentence,) = map_of([(points.double() + GRID, torch.eye(4, dtype=torch.float64)[None], None)]).diagnose()
    assert "they lie 631," in sentence and "in the map's frame, such as a national grid" in sentence
    T = T.clone()
    T[:, :3, 3] += GRID
    (sentence,) = map_of([(points.double() @ T[..., :3, :3].mT + T[:, None, :3, 3], T, None)]).diagnose()
    assert "the pose is applied twice" in sentence


def test_registered_points_around_a_base_60_m_away_are_named(walked):
    """Their rays would start at the map's origin."""
    points, _, base = walked[0]
    away = points + torch.tensor([60.0, 0.0, 0.0])
    (sentence,) = map_of([(away, torch.eye(4)[None].double(), base + shift(0, 60.0))]).diagnose()
    assert "they are in the map's frame" in sentence


def test_millimetres_of_a_narrow_view_stay_millimetres():
    narrow = torch.tensor([3000.0, 0, 0]) + 400 * torch.rand(1, 2000, 3, generator=torch.Generator().manual_seed(0))
    (sentence,) = map_of([(narrow, torch.eye(4)[None], None)]).diagnose()
    assert "as of millimetres" in sentence


def test_infinite_points_are_no_matter(walked, recwarn):
    """Simulators return misses as infinite points."""
    points, T, base = walked[0]
    points = points.clone()
    points[:, ::7], points[:, 3::7] = torch.inf, -torch.inf
    assert map_of([(points, T, base)]).diagnose() == [] and not recwarn.list
