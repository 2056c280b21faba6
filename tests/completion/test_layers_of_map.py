"""The completed layers of a map: where they are known, when they are computed, and how a map carries its network."""

import copy
import dataclasses
import pickle

import pytest
import torch

from tests.helpers import differences, mapped, nans, pose, scan, small_config, small_map, snapshot, with_completion
from torchelev import (
    CompletionConfig,
    CompletionNet,
    ElevationMap,
    ElevationMapConfig,
    FilterConfig,
    GridConfig,
)
from torchelev.io.map_file import load_map, save_map
from torchelev.maps import readable
from torchelev.stages.complete import COMPLETED, complete_map

SMOOTH = FilterConfig(layer="smooth", filter="box", inputs="completed")


def look(emap, seed=0, blind=()):
    """Update a map with a scan in which some environments see nothing."""
    cloud, T = scan(seed, emap.num_envs, 60)
    cloud[list(blind)] = torch.nan
    emap.update(cloud, T, T, 0.1)
    return emap


@pytest.fixture
def count(monkeypatch):
    """The list grows with every completion."""
    calls, compute = [], readable.completed_layers

    def counted(*args):
        calls.append(args)
        return compute(*args)

    monkeypatch.setattr(readable, "completed_layers", counted)
    return calls


# What the layers hold -------------------------------------------------------------------------------------------------


def test_they_are_what_the_network_makes_of_the_map():
    emap = look(small_map(2, **with_completion()))
    s = emap.state
    expected = emap.completion_net(
        s.elevation, s.validity, s.variance, s.upper_bound, s.bounded, s.time, resolution=0.1
    )
    assert emap.layers[-2:] == COMPLETED and s.bounded.any() and 0.1 < s.validity.float().mean() < 0.9
    assert torch.equal(emap.layer("completed"), expected.mean)
    torch.testing.assert_close(emap.layer("completed_std"), expected.std)
    assert expected.mean[~s.validity].std() > 1e-3


@pytest.mark.parametrize("when", ["read", "update"])
def test_they_are_known_where_an_environment_knows_anything(when):
    emap = small_map(3, **with_completion(when=when))
    look(emap, blind=[1])
    assert emap.validity.any(2).any(1).tolist() == [True, False, True]
    for name in COMPLETED:
        layer = emap.layer(name)
        assert layer[[0, 2]].isfinite().all() and layer[1].isnan().all()
        values, known = emap.read_layer(name)
        assert values.isfinite().all() and torch.equal(known, layer.isfinite())
    values, valid = emap.sample(torch.zeros(3, 1, 2), "completed")
    assert valid[:, 0].tolist() == [True, False, True] and values[1] == 0


def test_the_standard_deviation_has_that_of_the_pose_in_it():
    exact = small_map(2, **with_completion())
    cloud, T = scan(0, 2, 60)
    exact.update(cloud, T, T, 0.1)
    shifted = exact.state._replace(pose_covariance=torch.eye(3).repeat(2, 1, 1) * torch.tensor([0.0, 0.0, 0.04]))
    torch.testing.assert_close(exact.layer("completed", state=shifted), exact.layer("completed"))
    expected = (exact.layer("completed_std").square() + 0.04).sqrt()
    torch.testing.assert_close(exact.layer("completed_std", state=shifted), expected)


def test_without_completion_there_are_no_such_layers():
    emap = small_map()
    assert not set(COMPLETED) & set(emap.layers) and emap.completion_net is None
    for name in COMPLETED:
        for read in (emap.layer, lambda name: emap.sample(torch.zeros(1, 1, 2), name)):
            with pytest.raises(KeyError, match=f"'{name}'; give the config a CompletionConfig"):
                read(name)
    with pytest.raises(KeyError, match="'complete'; there are elevation"):
        emap.layer("complete")


def test_filters_read_them():
    emap = look(small_map(2, filters=(SMOOTH,), **with_completion()))
    assert emap.layer("smooth").isfinite().all()
    middle = emap.layer("completed")[0, 4:7, 4:7]
    assert middle.min() <= emap.layer("smooth")[0, 5, 5] <= middle.max()
    assert torch.equal(emap.layer("smooth", state=emap.state), emap.layer("smooth"))
    with pytest.raises(ValueError, match="must read layers that are made before it, got completed; there are"):
        small_map(filters=(SMOOTH,))


# When they are computed -----------------------------------------------------------------------------------------------


def test_they_are_computed_when_read_and_kept_until_the_map_changes(count):
    emap = small_map(2, filters=(SMOOTH,), **with_completion())
    look(emap)
    assert not count
    kept = [emap.layer(name) for name in (*COMPLETED, "smooth")]
    emap.sample(torch.zeros(2, 1, 2), "completed")
    assert len(count) == 1
    for tensor in kept:
        tensor.fill_(7.0)  # fresh ones
    assert not (emap.layer("completed") == 7).any() and len(count) == 1
    changes = (
        lambda: look(emap, 1),
        lambda: emap.reset(torch.tensor([1])),
        lambda: emap.initialize(torch.zeros(2, 4, 3), method="nearest"),
        lambda: emap.load_state(look(small_map(2), 2).state),
        lambda: emap.load_state_dict(emap.state_dict()),
        lambda: emap.double(),
    )
    for number, change in enumerate(changes, 2):
        change()
        read = emap.layer("completed")
        assert len(count) == number and torch.equal(read.isnan(), emap.layer("completed", state=emap.state).isnan())
        count.pop()
    torch.testing.assert_close(emap.layer("completed"), emap.layer("completed", state=emap.state))


@pytest.mark.parametrize("chunk", [None, 1])
def test_they_are_computed_once_at_the_end_of_an_update_if_asked(count, chunk):
    emap, lazy = small_map(2, **with_completion(when="update")), small_map(2, **with_completion())
    emap.chunk = chunk
    look(emap)
    assert len(count) == 1
    look(lazy)
    assert torch.equal(emap.layer("completed"), lazy.layer("completed")) and len(count) == 2
    emap.reset()
    assert emap.layer("completed").isnan().all()


def test_a_given_state_is_completed_each_time(count):
    emap, other = look(small_map(2, **with_completion())), look(small_map(2), 1)
    emap.layer("completed")
    read = emap.layer("completed", state=other.state)
    assert len(count) == 2 and not torch.equal(read, emap.layer("completed")) and len(count) == 2
    emap.load_state(other.state)
    torch.testing.assert_close(emap.layer("completed"), read)


def test_completion_does_not_change_the_map():
    plain, emap = look(look(small_map(2)), 1), small_map(2, **with_completion(when="update"))
    look(look(emap), 1)
    before = snapshot(emap)
    emap.layer("completed")
    assert differences(plain.state, emap.state) == differences(before, emap.state) == []


# Gradients, precision, modes of running -------------------------------------------------------------------------------


def test_gradients_reach_state_and_weights():
    emap = look(small_map(2, **with_completion()))
    emap.completion_net.requires_grad_(True)
    state = emap.state
    leaves = {name: getattr(state, name).clone().requires_grad_() for name in ("elevation", "variance", "upper_bound")}
    for name in COMPLETED:
        emap.layer(name, state=state._replace(**leaves)).sum().backward()
    grads = {name: leaf.grad for name, leaf in leaves.items()} | {n: p.grad for n, p in _parameters(emap)}
    assert all(grad.isfinite().all() for grad in grads.values())
    assert all(grads[name].any() for name in ("elevation", "variance", "cell", "measured", "vote", "answer"))
    assert not leaves["elevation"].grad[~state.validity].any(), "unknown cells have no say"
    assert not emap.layer("completed").requires_grad, "what is kept has no gradient"


def _parameters(emap):
    return emap.completion_net.named_parameters()


@pytest.mark.parametrize("dtype", [torch.float16, torch.bfloat16, torch.float64])
def test_maps_of_other_precision(dtype):
    emap = look(small_map(2, **with_completion()))
    single = emap.layer("completed")
    emap.to(dtype)
    for name in COMPLETED:
        layer = emap.layer(name)
        assert layer.dtype == dtype and layer.isfinite().all()
    torch.testing.assert_close(emap.layer("completed").float(), single, atol=0.01, rtol=0)
    if dtype == torch.float64:
        torch.testing.assert_close(emap.layer("completed"), single.double(), atol=1e-5, rtol=0)
        mixed = copy.deepcopy(emap)
        mixed.completion_net.float()  # a network of the other precision is converted
        torch.testing.assert_close(mixed.layer("completed"), emap.layer("completed"))


def test_they_are_right_100_km_from_the_origin():
    emap, far = (look(small_map(2, **with_completion())) for _ in range(2))
    far.corner += torch.tensor([1_000_000, -1_000_000])
    assert torch.equal(far.layer("completed"), emap.layer("completed"))


@pytest.mark.parametrize("when", ["read", "update"])
def test_what_is_kept_in_inference_mode_can_be_used_outside(when, tmp_path):
    with_completion()["completion_net"].save(tmp_path / "net.pt")
    with torch.inference_mode():
        emap = look(small_map(2, completion=CompletionConfig(weights=tmp_path / "net.pt", when=when)))
        inside = emap.layer("completed")
    values, _ = emap.read_layer("completed")
    assert not values.is_inference() and torch.equal(values, inside)
    weight = torch.ones(1, requires_grad=True)
    (weight * values).sum().backward()
    assert weight.grad is not None
    assert not any(p.is_inference() for p in emap.completion_net.parameters())


@pytest.mark.compiles
@pytest.mark.slow(3)
def test_completion_compiles_as_one_graph():
    emap = look(small_map(2, **with_completion()))
    grid, weights = emap.cfg.grid, emap.completion_net.weights

    def run(state):
        return complete_map(state, grid, weights)

    with torch.no_grad():
        compiled = torch.compile(run, fullgraph=True, backend="aot_eager")(emap.state)
    torch.testing.assert_close(compiled, run(emap.state))


# Config, network, copies and files ------------------------------------------------------------------------------------


def test_config_round_trip_and_older_configs():
    cfg = small_config(completion=CompletionConfig(weights="some.pt", when="update"))
    assert ElevationMapConfig.from_dict(cfg.to_dict()) == cfg
    assert ElevationMapConfig.from_dict({"completion": {}}).completion == CompletionConfig()
    older = {name: value for name, value in small_config().to_dict().items() if name != "completion"}
    assert ElevationMapConfig.from_dict(older) == small_config() and small_config().completion is None


def test_refusals():
    with pytest.raises(ValueError, match=r"cfg.grid.resolution: must be 0.02 to 0.1 m for completion, got 0.2; choose"):
        small_config(resolution=0.2, completion=CompletionConfig())
    for resolution in (0.02, 0.1):
        small_config(resolution=resolution, completion=CompletionConfig())
    with pytest.raises(ValueError, match=r"cfg.grid.resolution"):
        ElevationMapConfig(grid=GridConfig(resolution=0.01, length_x=1.0, length_y=1.0), completion=CompletionConfig())
    with pytest.raises(ValueError, match="completion.when: must be one of read, update, got 'never'"):
        CompletionConfig(when="never")
    with pytest.raises(TypeError, match="completion.weights: must be a path or None"):
        CompletionConfig(weights=3)
    with pytest.raises(TypeError, match="cfg.completion: must be a CompletionConfig or None, got True"):
        ElevationMapConfig(completion=True)
    with pytest.raises(ValueError, match="config.completion.wen: is not a setting"):
        ElevationMapConfig.from_dict({"completion": {"wen": "read"}})
    with pytest.raises(ValueError, match="completion_net: must be None unless the config asks for completion"):
        ElevationMap(small_config(), completion_net=CompletionNet())
    with pytest.raises(TypeError, match="completion_net: must be a CompletionNet, got Linear"):
        ElevationMap(small_config(completion=CompletionConfig()), completion_net=torch.nn.Linear(1, 1))
    with pytest.raises(FileNotFoundError, match="must be a file of weights"):
        ElevationMap(small_config(completion=CompletionConfig(weights="/nowhere/none.pt")))


def test_the_network_is_given_or_read_from_a_file_and_frozen(tmp_path):
    net = with_completion(3)["completion_net"].requires_grad_(True)
    net.save(tmp_path / "net.pt")
    given = small_map(2, completion=CompletionConfig(), completion_net=net)
    assert given.completion_net is net and net.cell.requires_grad
    read = small_map(2, completion=CompletionConfig(weights=tmp_path / "net.pt"))
    assert not any(p.requires_grad for p in read.completion_net.parameters())
    assert torch.equal(look(read).layer("completed"), look(given).layer("completed"))


def test_copies_checkpoints_and_files_carry_the_weights(tmp_path):
    emap = look(small_map(2, **with_completion(1)))
    expected = emap.layer("completed")
    other = small_map(2, **with_completion(2, weights="elsewhere.pt", when="update"))
    assert not torch.equal(look(other).layer("completed"), expected)
    other.load_state_dict(emap.state_dict())
    assert torch.equal(other.layer("completed"), expected)
    for twin in (copy.deepcopy(emap), pickle.loads(pickle.dumps(emap))):
        assert torch.equal(twin.layer("completed"), expected)
        assert torch.equal(twin.reset() or look(twin).layer("completed"), expected)
    save_map(tmp_path / "map.npz", emap)
    loaded = load_map(tmp_path / "map.npz", env_ids=[1])
    torch.testing.assert_close(loaded.layer("completed"), expected[1:])
    assert not any(p.requires_grad for p in loaded.completion_net.parameters())


def test_checkpoints_of_maps_with_and_without_completion_do_not_fit():
    plain, emap = mapped(), small_map(2, **with_completion())
    for source, target in ((plain, emap), (emap, plain)):
        with pytest.raises(ValueError, match="state_dict: must be of the same config, got other completion"):
            target.load_state_dict(source.state_dict())
    checkpoint = plain.state_dict()
    del checkpoint["_extra_state"]["config"]["completion"]  # as written before there was completion
    small_map(2).load_state_dict(checkpoint)


def test_environments_that_never_saw_a_point_read_unknown():
    emap = small_map(2, **with_completion(when="update"))
    emap.update(nans(2), pose(num_envs=2), pose(num_envs=2), 0.1)
    assert all(emap.layer(name).isnan().all() for name in COMPLETED)
    assert dataclasses.replace(emap.cfg, completion=None) == small_config()
