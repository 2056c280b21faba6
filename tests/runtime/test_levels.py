"""Levels of the C library: Python's, walk after walk."""

import dataclasses
import json

import numpy as np
import pytest
import torch

import torchelev as te
from tests.levels.walks import line, look, make_map
from torchelev.io.map_file import map_arrays
from torchelev.runtime.bundle.groups import image_settings
from torchelev.runtime.library import CMap, LibraryError
from torchelev.sim.exact import covered_scenes

BRIDGE, DECK = covered_scenes.bridge(), 12 * covered_scenes.RISE
ROAD = line((0.0, -2.0, 0.0), (0.0, 1.0, 0.0), 6)
CONFIGS = {
    "default": {},
    "by gap, of five": {"levels": te.LevelsConfig(max_levels=5, separation="gap", min_support=0.0, max_blind=0.0)},
    "bare": {"drift": None, "raycast": None, "overlap": None},
    "gated": {"sensor": te.SensorConfig(body=te.BodyConfig(), max_distance=4.0)},
}


def pair(library, **settings):
    emap = make_map(**settings)
    return emap, CMap(library, json.dumps(emap.cfg.to_dict()), num_threads=2)


def update(maps, place, seed=0, **more):
    points, T_map_sensor, T_map_base = look(BRIDGE, *place, seed=seed)
    maps[0].update(points, T_map_sensor, T_map_base, dt=0.2)
    maps[1].update(points.numpy(), T_map_sensor.numpy(), T_map_base[0].numpy(), 0.2)


def require_same(maps, atol=2e-5):
    emap, found = maps
    for name in emap.layers:
        wanted = emap.layer(name)[0].numpy()
        np.testing.assert_allclose(found.layer(name), wanted, rtol=0, atol=atol, err_msg=name)
    ground = emap.layer("elevation")
    assert (emap.layer("ceiling") > ground).any() and np.isinf(found.layer("ceiling")).any()


def require_same_levels(maps):
    levels = {n: v for n, v in map_arrays(maps[0]).items() if n.startswith("levels_")}
    for key, wanted in levels.items():
        assert maps[1].tensor(key, wanted.dtype).tobytes() == wanted.tobytes(), key


@pytest.mark.parametrize("name", CONFIGS)
def test_layers_are_those_of_python(library, name):
    maps = pair(library, **CONFIGS[name])
    for k, place in enumerate([*ROAD, (0.0, 0.0, DECK), (0.4, 0.0, DECK)]):
        update(maps, place, seed=k)
        require_same(maps)
    require_same_levels(maps)


def test_changes_besides_updates(library):
    maps = pair(library)
    for k, place in enumerate(ROAD):
        update(maps, place, seed=k)
    center, T = np.array([0.0, -0.5]), np.eye(4)
    maps[0].clear_around(torch.from_numpy(center)[None], 0.6)
    maps[1].clear_around(center, 0.6)

    for name in ("ceiling", "clearance"):
        np.testing.assert_allclose(maps[1].layer(name), maps[0].layer(name)[0].numpy(), atol=1e-3, err_msg=name)
    T[0, 3] = 2.0
    maps[1].move(T)
    nothing = torch.full((1, 1, 3), torch.nan)
    pose = torch.from_numpy(T)[None]
    maps[0].update(nothing, pose, pose, dt=0.0)
    np.testing.assert_allclose(maps[1].layer("ceiling"), maps[0].layer("ceiling")[0].numpy(), atol=1e-6)
    assert np.isfinite(maps[1].layer("ceiling")).sum() > 100
    maps[1].reset()
    assert np.isnan(maps[1].layer("ceiling")).all()


def test_a_window_that_comes_back_has_lost_what_left(library):
    emap, found = maps = pair(library)
    for k, place in enumerate(ROAD):
        update(maps, place, seed=k)
    before = np.isfinite(found.layer("ceiling")).sum()
    nothing = torch.full((1, 1, 3), torch.nan)
    for x, y in [(1.0, -3.0), (0.0, 1.0)]:
        pose = te.frames.transform(torch.tensor([x, y, 0.45]), torch.tensor([1.0, 0.0, 0.0, 0.0])).double()
        emap.update(nothing, pose[None], pose[None], dt=0.0)
        found.move(pose.numpy())
    assert 0 < np.isfinite(found.layer("ceiling")).sum() < before
    require_same_levels(maps)
    np.testing.assert_array_equal(found.layer("ceiling"), emap.layer("ceiling")[0].numpy())


def test_a_saved_map_goes_on(library, tmp_path):
    emap, found = maps = pair(library)
    for k, place in enumerate(ROAD[:4]):
        update(maps, place, seed=k)
    found.save(tmp_path / "map.safetensors")
    other = CMap(library, json.dumps(emap.cfg.to_dict()))
    other.load(tmp_path / "map.safetensors")
    for k, place in enumerate(ROAD[4:]):
        update((emap, other), place, seed=k)
    require_same((emap, other))
    plain = CMap(library, json.dumps(dataclasses.replace(emap.cfg, levels=None).to_dict()))
    with pytest.raises(LibraryError, match="the map of another config"):
        plain.load(tmp_path / "map.safetensors")
    saved = (tmp_path / "map.safetensors").read_bytes()
    assert saved.count(b"levels_free_top") == 1 and np.float32(-np.inf).tobytes() in saved
    (tmp_path / "map.safetensors").write_bytes(saved[:-1] + b"\x02")
    with pytest.raises(LibraryError, match="damaged: levels_is_open holds what no update leaves"):
        other.load(tmp_path / "map.safetensors")


def test_one_level_is_a_map_without(library):
    cfg = make_map(levels=te.LevelsConfig(max_levels=1)).cfg
    found = CMap(library, json.dumps(cfg.to_dict()))
    with pytest.raises(LibraryError, match="layer: must be one of elevation, .*normal_z, got 'ceiling'"):
        found.layer("ceiling")
    with pytest.raises(LibraryError, match="name: must be a tensor of MapState, got 'levels_lower'"):
        found.tensor("levels_lower", np.float32)


def test_images_of_the_clearance(library):
    image = te.MapImage(layers=("elevation", "clearance"), length_x=2.0, length_y=2.0, max_clearance=1.9)
    maps = pair(library)
    for k, place in enumerate(ROAD):
        update(maps, place, seed=k)
    T = look(BRIDGE, *ROAD[-1])[2]
    wanted, found = image(maps[0], T)[0].numpy(), maps[1].image(json.dumps(image_settings(image)))(T[0].numpy())
    np.testing.assert_allclose(found, wanted, atol=2e-5)
    assert wanted[1].max() == pytest.approx(1.9, abs=1e-6) and (wanted[1] > 0).mean() > 0.3
    plain = CMap(library, "{}")
    with pytest.raises(LibraryError, match="image.layers: needs a map with levels, which knows ceilings"):
        plain.image('{"layers": ["clearance"]}')
    with pytest.raises(LibraryError, match="layout.surface: needs Python: this library scans no ceilings"):
        plain.scan('{"pattern": [[0, 0]], "surface": "ceiling"}')
