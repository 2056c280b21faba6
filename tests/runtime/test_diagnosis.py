"""Diagnosis in C: the sentences of Python, of the rules that it has."""

import json

import pytest
import torch

import torchelev as te
from tests.diagnosis.walks import CFG, DT
from tests.helpers import pose
from tests.runtime.test_maps import numpy, update
from tests.stages.test_disagreement import GRID, clouds
from torchelev.maps.buffers import name_tensors
from torchelev.runtime.library import CMap
from torchelev.sim import DepthCamera, mount, walk
from torchelev.sim.exact import scenes

SCENE = scenes.mixed(0)
PATH = walk(SCENE, [(-2.6, 0.05), (0.6, 0.05), (0.6, -0.6)], dt=DT, T_base_sensor=mount(35.0))
SCANS = [
    (DepthCamera(width=80, height=60, max_range=6.0).cast(SCENE, T), T, base)
    for T, base in zip(PATH.T_map_sensor[:20], PATH.T_map_base[:20], strict=True)
]
FAR = pose((3e5, 5e6, 0.0))[0]
UP, ASIDE = pose((0.0, 0.0, 1.5))[0] - torch.eye(4), pose((50.0, 0.0, 0.0))[0] - torch.eye(4)
GATES = {"grid": {"resolution": 0.08, "length_x": 8.0, "length_y": 8.0}}
# What is done to a scan, the settings, and words of the first sentence.
MISTAKES = {
    "millimetres": (lambda p, T, base: (1000 * p, T, base), {}, DT),
    "are in the map frame already": (lambda p, T, base: (in_map(p, FAR @ T), FAR @ T, FAR @ base), {}, DT),
    "such as a national grid": (lambda p, T, base: (in_map(p, FAR), T, base), {}, DT),
    "the sensor moves by": (lambda p, T, base: (p, T, torch.linalg.inv(base)), {}, DT),
    "is the identity": (lambda p, T, base: (in_map(p, T), torch.eye(4, dtype=torch.float64), base), {}, DT),
    "NaN or infinite": (lambda p, T, base: (p * torch.nan, T, base), {}, DT),
    "sensor.min_distance": (None, {"sensor": {"min_distance": 30.0}}, DT),
    "sensor.exclusion": (None, {"sensor": {"exclusion": {"offset": -9.0, "height": -8.0}}}, DT),
    "sensor.body": (None, {"sensor": {"body": {"lower": [-20, -20, -20], "upper": [20, 20, 20]}}}, DT),
    "give T_map_base, which the window follows": (lambda p, T, base: (p, T + ASIDE, None), {}, DT),
    "check T_map_base": (lambda p, T, base: (p, T, base + ASIDE), {}, DT),
    "enlarge grid.length_x": (None, {"grid": {"resolution": 0.08, "length_x": 0.16, "length_y": 0.16}}, DT),
    "overlap.height": (lambda p, T, base: (p, T, base - UP), {"overlap": {"height": 0.2}}, DT),
    "give seconds, not ms or ns": (None, {}, 1000 * DT),
    "dt: 0 s in all updates": (None, {}, 0.0),
}


def in_map(points, T):
    return (points.double() @ T[:3, :3].mT + T[:3, 3]).float()


def both(library, scans, cfg=CFG, dt=DT):
    emap, found = te.ElevationMap(cfg), CMap(library, json.dumps(cfg.to_dict()))
    for points, T, base in scans:
        instant = points[None], T[None], base, dt
        update(emap, *instant)
        found.update(*numpy(*instant))
    return emap, found


@pytest.mark.slow(1)
@pytest.mark.parametrize("words", MISTAKES)
def test_a_mistake_is_named_as_in_python(library, words):
    mistake, settings, dt = MISTAKES[words]
    scans = [mistake(*scan) for scan in SCANS] if mistake else SCANS
    emap, found = both(library, scans, te.ElevationMapConfig.from_dict(GATES | settings), dt)
    sentences = found.diagnose()
    assert words in "\n".join(sentences)
    assert sentences == [text for text in emap.diagnose() if text in sentences]
    found.reset()
    assert found.diagnose() == []


@pytest.mark.parametrize("number", [0, 1, 9, 20])
def test_sound_scans_are_passed_over(library, number):
    emap, found = both(library, SCANS[:number])
    assert found.diagnose() == emap.diagnose() == []


@pytest.mark.parametrize("count", [2, 3])
def test_sensors_that_take_turns_are_named(library, count):
    scans = [(scan[0, k], torch.eye(4, dtype=torch.float64), torch.eye(4, dtype=torch.float64))
             for scan in clouds(0.05, count, num_scans=20) for k in range(count)]  # fmt: skip
    emap, found = both(library, scans, te.ElevationMapConfig(grid=GRID))
    assert f"every {count} updates" in found.diagnose()[0]
    assert found.diagnose() == emap.diagnose()


def test_scans_that_contradict_each_other(library):
    ground = torch.rand(4000, 3, generator=torch.Generator().manual_seed(0)) * torch.tensor([6.0, 6.0, 0.0]) - 3.0
    T = torch.eye(4, dtype=torch.float64)
    scans = [(ground, T + (3 + k % 2) / 1.5 * UP, None) for k in range(4)]
    emap, found = both(library, scans)
    assert found.diagnose()[-1] == emap.diagnose()[-1] and "contradict the map" in found.diagnose()[-1]


def test_a_diagnosis_changes_nothing(library):
    _, found = both(library, SCANS[:10])
    _, other = both(library, SCANS[:5])
    for points, T, base in SCANS[5:10]:
        other.diagnose()
        other.update(*numpy(points[None], T[None], base, DT))
    assert found.diagnose() == other.diagnose()
    for name in name_tensors(te.ElevationMap(CFG).state):
        assert found.tensor(name, "u1").tobytes() == other.tensor(name, "u1").tobytes(), name


def test_gates_that_share_the_points_are_counted(library):
    """Half of the points are too near, the others above the ramp: no gate takes nearly all."""
    cfg = te.ElevationMapConfig.from_dict(
        GATES | {"sensor": {"min_distance": 1.5, "exclusion": {"offset": -9.0, "height": -8.0}}}
    )
    emap, found = both(library, SCANS[:3], cfg)
    (sentence,) = found.diagnose()
    assert "gates let 0 of" in sentence and "range" in sentence and "overhang" in sentence
    assert found.diagnose() == [text for text in emap.diagnose() if text in found.diagnose()]


def test_cells_that_rays_clear_are_counted(library):
    """The ground was half a metre too high; then rays pass below most of it."""
    grid = te.GridConfig(resolution=0.1, length_x=2.0, length_y=2.0)
    cfg = te.ElevationMapConfig(grid=grid, drift=None, overlap=None, raycast=te.RaycastConfig(gate=1e9, min_time=0.0))
    xy = 2 * torch.rand(4000, 2, generator=torch.Generator().manual_seed(0)) - 1
    near = torch.cat([xy, torch.full((4000, 1), -0.5)], 1)
    far = torch.cat([1.5 * xy / xy.norm(dim=1, keepdim=True), torch.full((4000, 1), -1.0)], 1)
    T = pose((0.0, 0.0, 1.0))[0].double()
    emap, found = both(library, [(near, T, T), (far, T, T)], cfg)
    assert any("are left, as rays pass below them" in text for text in found.diagnose())
    assert found.diagnose() == [text for text in emap.diagnose() if text in found.diagnose()]


def test_vegetation_contradicts_nothing(library):
    """Points at all heights from 0 to 1 m: the gate rejects many, whatever the poses."""
    generator = torch.Generator().manual_seed(0)
    T = torch.eye(4, dtype=torch.float64)
    scale, shift = torch.tensor([6.0, 6.0, 1.0]), torch.tensor([-3.0, -3.0, -2.0])
    scans = [(torch.rand(9000, 3, generator=generator) * scale + shift, T, None) for _ in range(6)]
    emap, found = both(library, scans)
    statistics = emap.statistics
    assert statistics.rejected_outlier > 0.3 * (statistics.points_used + statistics.rejected_outlier)
    assert found.diagnose() == emap.diagnose() == []
