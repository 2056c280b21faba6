"""A map that was saved and loaded goes on as if it had not been."""

import json
import math

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from tests.helpers import differences, mapped, scan, small_config, snapshot
from torchelev import (
    AgingConfig,
    BodyConfig,
    DriftConfig,
    ElevationMap,
    FusionConfig,
    OverlapConfig,
    RaycastConfig,
    SensorConfig,
)
from torchelev.filters import FilterConfig, register
from torchelev.io.export import load_map, load_npz, save_map, save_npz, take, write_npz
from torchelev.io.map_file import FORMAT, VERSION, read_npz
from torchelev.state import MapState, Statistics, map_layers

LIVELY = dict(
    sensor=SensorConfig(body=BodyConfig(lower=(-0.1, -0.1, -2), upper=(0.1, 0.1, 2))),
    raycast=RaycastConfig(min_time=0.05, min_incidence=0.05),
    drift=DriftConfig(min_points=5),
    overlap=OverlapConfig(radius=0.5, height=1.2),
)
NEWER = VERSION + 1
UNCERTAIN = 1e-6 * torch.eye(6, dtype=torch.float64).repeat(2, 1, 1)


@register
def raised_by(layer, *, steps):
    return layer[0] + steps[0], layer[1]


def go_on(emap, seeds=(7, 8)):
    for seed in seeds:
        cloud, T = scan(seed, emap.num_envs)
        emap.update(cloud, T, T, 0.3)
    return emap


def rewrite(path, **changes):
    """Change arrays of a file; None leaves them out."""
    arrays = {**dict(np.load(path)), **changes}
    np.savez(path, **{name: array for name, array in arrays.items() if array is not None})


def rewrite_header(path, **changes):
    header = json.loads(str(np.load(path)["header"]))
    rewrite(path, header=np.array(json.dumps({**header, **changes})))


@pytest.fixture
def path(tmp_path):
    save_map(tmp_path / "map.npz", mapped(pose_covariance=UNCERTAIN))
    return tmp_path / "map.npz"


@pytest.mark.slow(1)
@given(st.sampled_from([torch.float16, torch.bfloat16, torch.float32, torch.float64]), st.integers(1, 3))
def test_a_loaded_map_goes_on_to_the_bit(tmp_path, dtype, num_envs):
    full = torch.promote_types(dtype, torch.float32)  # half precision is for reading
    emap = go_on(ElevationMap(small_config(**LIVELY), num_envs).to(full), range(3)).to(dtype)
    save_map(tmp_path / "map.npz", emap)
    loaded = load_map(tmp_path / "map.npz")
    assert loaded.cfg == emap.cfg and loaded.num_envs == num_envs and loaded.elevation.dtype == dtype
    assert differences(loaded.state, emap.state) == []
    before = snapshot(emap.to(full))
    assert differences(go_on(loaded.to(full)).state, go_on(emap).state) == []
    assert "elevation" in differences(before, emap.state)


def test_the_state_that_is_saved_is_no_blank_one(path):
    blank, loaded = ElevationMap(small_config(), 2), load_map(path)
    assert set(MapState._fields[:-1]) - set(differences(blank.state, loaded.state)) == set()


def test_a_config_of_every_kind_of_value_comes_back(tmp_path):
    cfg = small_config(
        sensor=SensorConfig(body=BodyConfig()),
        aging=AgingConfig(variance_rate=0.0),
        fusion=FusionConfig(edges=None),
        drift=None,
        raycast=None,
        overlap=None,
        traversability=None,
        filters=(FilterConfig(layer="raised", filter="raised_by", settings={"steps": (0.5, math.inf)}),),
    )
    save_map(tmp_path / "map.npz", ElevationMap(cfg))
    assert load_map(tmp_path / "map.npz").cfg == cfg


def test_some_environments_alone(path):
    whole, some = load_map(path), load_map(path, env_ids=[1, 0, 1])
    for name, values in some.state._asdict().items():
        if name != "statistics":
            assert torch.equal(values, getattr(whole.state, name)[torch.tensor([1, 0, 1])]), name
    go_on(some, [9])
    assert load_map(path, env_ids=torch.tensor([0])).num_envs == 1


def test_the_device_is_the_callers(path):
    assert load_map(path, device="meta").device.type == "meta"


@pytest.mark.skipif(not torch.cuda.is_available(), reason="needs a CUDA device")
def test_a_map_moves_between_devices_by_file(path, tmp_path):
    on_gpu = load_map(path, "cuda")
    save_map(tmp_path / "gpu.npz", on_gpu)
    assert differences(load_map(tmp_path / "gpu.npz").state, load_map(path).state) == []


def test_the_file_is_plain_numpy_and_keeps_its_name(tmp_path):
    emap = mapped()
    save_map(tmp_path / "map.data", emap)
    with np.load(tmp_path / "map.data", allow_pickle=False) as arrays:
        expected = {"header", *MapState._fields[:-1]} | {f"last_{name}" for name in Statistics._fields}
        assert set(arrays.files) == expected
        np.testing.assert_array_equal(arrays["support"], emap.state.support.numpy())
        assert all(np.isfinite(arrays[name]).all() for name in MapState._fields[:-1])


# What is refused ------------------------------------------------------------------------------------------------------


def test_refuses_other_files(tmp_path):
    with pytest.raises(FileNotFoundError):
        load_map(tmp_path / "none.npz")
    other = tmp_path / "other.npz"
    for content in (b"", b"not a zip"):
        other.write_bytes(content)
        with pytest.raises(ValueError, match=r"other\.npz: must be an \.npz file.*write it with save_map"):
            load_map(other)
    np.save(tmp_path / "array.npy", np.zeros(3))
    with pytest.raises(ValueError, match=r"array\.npy: must be an \.npz file"):
        load_map(tmp_path / "array.npy")
    np.savez(other, points=np.zeros((4, 3)))
    with pytest.raises(ValueError, match=r"other\.npz: must be a whole map, got an \.npz with points"):
        load_map(other)
    np.savez(other, header=np.array("[1]"))
    with pytest.raises(ValueError, match="must be a whole map"):
        load_map(other)


def test_says_who_reads_layers_alone(tmp_path):
    write_npz(tmp_path / "layers.npz", take(mapped()))
    with pytest.raises(ValueError, match="or read layers alone with load_npz"):
        load_map(tmp_path / "layers.npz")


def test_layers_of_one_map_are_the_whole_map_too(tmp_path):
    """`torchelev map` writes them: one environment, to the bit, for `load_map` as for NumPy."""
    emap = mapped()
    save_npz(tmp_path / "map.npz", emap, env=1)
    loaded, saved = load_map(tmp_path / "map.npz"), load_npz(tmp_path / "map.npz")
    assert loaded.num_envs == 1 and loaded.cfg == emap.cfg and set(saved.layers) == set(emap.layers)
    assert differences(loaded.state, map_layers(lambda value: value[1:2], emap.state)) == []
    for name, layer in saved.layers.items():
        np.testing.assert_array_equal(loaded.layer(name)[0].numpy(), layer)


def test_refuses_a_file_that_was_cut_or_damaged(path):
    whole = path.read_bytes()
    path.write_bytes(whole[: len(whole) // 2])
    with pytest.raises(ValueError, match="a truncated file"):
        load_map(path)
    middle = len(whole) // 2
    path.write_bytes(whole[:middle] + bytes(64) + whole[middle + 64 :])
    with pytest.raises(ValueError, match=r"map\.npz: damaged"):
        load_map(path)


def test_refuses_pickled_objects(tmp_path):
    np.savez(tmp_path / "map.npz", header=np.array([{"format": FORMAT}], dtype=object))
    with pytest.raises(ValueError, match="damaged, or not an .npz file"):
        read_npz(tmp_path / "map.npz", "")


def test_refuses_a_newer_format_before_anything_else(path):
    rewrite_header(path, version=NEWER, config={"unheard": 1}, dtype="float8")
    with pytest.raises(ValueError, match=rf"must be of format version 1 to {VERSION}, got {NEWER}; .*newer torchelev"):
        load_map(path)


@pytest.mark.parametrize(
    "changes, message",
    [
        (dict(dtype="save"), "dtype must be one of float16, bfloat16, float32, float64, got save"),
        (dict(config={"grids": {}}), "config.grids: is not a setting"),
        (dict(config=small_config((10, 12)).to_dict()), r"elevation: expected \(2, 10, 12\), got \(2, 12, 10\)"),
    ],
)
def test_refuses_a_header_that_does_not_fit(path, changes, message):
    rewrite_header(path, **changes)
    with pytest.raises(ValueError, match=message):
        load_map(path)


@pytest.mark.parametrize(
    "changes, message",
    [
        (dict(support=None), r"map\.npz: must have an array support, got none"),
        (dict(corner=None), r"map\.npz: must have an array corner"),
        (dict(last_drift_error=None), "must have an array last_drift_error"),
        (dict(time=np.zeros((3, 12, 10))), r"time: expected \(2, 12, 10\), got \(3, 12, 10\)"),
        (dict(base_height=np.zeros((2, 1))), r"base_height: expected \(2,\), got \(2, 1\)"),
    ],
)
def test_refuses_arrays_that_do_not_fit(path, changes, message):
    rewrite(path, **changes)
    with pytest.raises(ValueError, match=message):
        load_map(path)


def test_reads_a_file_of_version_1(path):
    """From before cells had challengers, poses a covariance and maps a clock."""
    rewrite_header(path, version=1)
    rewrite(path, challenger=None, challenger_support=None, pose_covariance=None, elapsed=None)
    emap = load_map(path)
    assert not emap.state.pose_covariance.any() and not emap.state.elapsed.any()
    assert emap.validity.any() and not emap.challenger.any() and not emap.challenger_support.any()


def test_reads_a_file_of_version_2_without_the_younger_fields(path):
    whole = load_map(path)
    rewrite(path, pose_covariance=None, elapsed=None)
    emap = load_map(path, env_ids=[1])
    assert emap.state.elapsed.tolist() == [0] and not emap.state.pose_covariance.any()
    others = load_map(path).state
    assert differences(others, whole.state) == ["pose_covariance", "elapsed"]


def test_reads_a_file_of_before_without_its_predictions(path):
    before = load_map(path).state
    predicted = before.validity & (torch.rand(before.validity.shape, generator=torch.Generator().manual_seed(0)) < 0.5)
    config = json.loads(str(np.load(path)["header"]))["config"]
    bounds = {"upper_bound": before.elevation.numpy(), "bounded": (predicted | before.bounded).numpy()}
    rewrite(path, support=torch.where(predicted, -1.0, before.support).numpy(), **bounds)
    before = load_map(path).state
    rewrite_header(path, config={**config, "completion": {"weights": None, "when": "read", "write_back": True}})
    state = load_map(path).state
    assert predicted.any() and torch.equal(state.validity, before.validity & ~predicted)
    assert torch.equal(state.elevation[state.validity], before.elevation[state.validity])
    assert (state.support >= 0).all() and not state.elevation[predicted].any()
    assert torch.equal(state.bounded, before.bounded) and torch.equal(state.upper_bound, before.upper_bound)


@pytest.mark.parametrize("env_ids", [[2], [-1], [], [[0]], [0.0], torch.tensor([True, False])])
def test_refuses_environments_that_do_not_exist(path, env_ids):
    with pytest.raises(ValueError, match="env_ids"):
        load_map(path, env_ids=env_ids)


def test_a_save_that_fails_leaves_the_older_file(path, monkeypatch):
    before = path.read_bytes()

    def full_disk(file, **arrays):
        file.write(b"half")
        raise OSError("no space left")

    emap = load_map(path)
    monkeypatch.setattr(np, "savez_compressed", full_disk)
    with pytest.raises(OSError, match="no space"):
        save_map(path, emap)
    assert path.read_bytes() == before and [p.name for p in path.parent.iterdir()] == [path.name]


@pytest.mark.slow(3)
@pytest.mark.parametrize("save, load", [(save_map, load_map), (save_npz, load_npz)])
def test_a_damaged_file_is_a_value_error_that_names_it(tmp_path, save, load):
    """Truncations and flipped bits all over the file; what cannot be noticed may load."""
    path, rng = tmp_path / "map.npz", np.random.default_rng(0)
    save(path, mapped())
    whole, refused = path.read_bytes(), 0
    damaged = [whole[:cut] for cut in rng.integers(0, len(whole), 60)]
    for place in rng.integers(0, len(whole), 300):
        damaged.append(whole[:place] + bytes([whole[place] ^ (1 << int(rng.integers(8)))]) + whole[place + 1 :])
    for content in damaged:
        path.write_bytes(content)
        try:
            load(path)
        except ValueError as error:
            assert str(path) in str(error) and "\n" not in str(error)
            refused += 1
    assert refused > 0.7 * len(damaged)


@pytest.mark.parametrize(
    "changes, message",
    [
        (dict(head={"cells": 3}), r"map\.npz: "),
        (dict(head=3), r"map\.npz: "),
        (dict(config=[1]), r"map\.npz: "),
        (dict(config={"grid": 3}), r"map\.npz: "),
        (dict(dtype=["float32"]), r"map\.npz: dtype must be one of float16"),
    ],
)
def test_refuses_a_header_of_other_types(path, changes, message):
    rewrite_header(path, **changes)
    with pytest.raises(ValueError, match=message):
        load_map(path)


@pytest.mark.parametrize("values", ["a", 1j, True])
def test_refuses_arrays_of_other_kinds(path, values):
    rewrite(path, variance=np.full((2, 12, 10), values))
    with pytest.raises(ValueError, match=r"map\.npz, variance: expected numbers of kind 'f'"):
        load_map(path)
