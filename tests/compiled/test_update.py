"""Compilation: few graphs, the same results, shared where inputs are alike and apart where they are not."""

import itertools

import pytest
import torch
from torch._dynamo.callback import callback_handler
from torch._dynamo.testing import CompileCounter

import torchelev
from tests.helpers import assert_close, differences, mapped, scan, small_config, small_map, snapshot
from torchelev import ElevationMap, SensorConfig
from torchelev.compiled.update import Graphs, graphs_of
from torchelev.layers import LAYERS

pytestmark = pytest.mark.compiles


def core(emap):
    """The differentiable core as one function."""

    def run(state, points, T_map_sensor, T_map_base, dt):
        return emap(state, emap.measure(points, T_map_sensor, T_map_base, dt))

    return run


@pytest.mark.slow(6)
@pytest.mark.parametrize("with_base", [True, False])
@pytest.mark.parametrize("sensors", [None, 2])
def test_the_core_compiles_as_one_graph(with_base, sensors):
    emap = mapped(sensor=SensorConfig(body=torchelev.BodyConfig()))
    cloud, T = scan(5)
    base = T if with_base else None
    if sensors:
        cloud, T_sensor = cloud.unflatten(1, (sensors, -1)), T[:, None].repeat(1, sensors, 1, 1)
    else:
        T_sensor = T
    dt = torch.full((2,), 0.1)
    compiled = torch.compile(core(emap), fullgraph=True, backend="eager")
    state = compiled(snapshot(emap), cloud, T_sensor, base, dt)
    assert_close(state, core(emap)(emap.state, cloud, T_sensor, base, dt), 1e-6)


def test_readers_and_resets_compile_as_one_graph():
    emap = mapped()

    def read(state, xy):
        layers = [emap.layer(name, state=state) for name in LAYERS]
        return layers, [emap.sample(xy, mode=mode, state=state) for mode in ("bilinear", "nearest")]

    xy = torch.rand(2, 9, 2, generator=torch.Generator().manual_seed(0)) - 0.5
    compiled = torch.compile(read, fullgraph=True, backend="eager")(emap.state, xy)
    torch.testing.assert_close(compiled, read(emap.state, xy), equal_nan=True)
    torch.compile(emap.reset, fullgraph=True, backend="eager")(mask=torch.tensor([True, False]))
    assert not emap.validity[0].any() and emap.validity[1].any()


@pytest.mark.slow(13)
def test_gradients_through_the_compiled_core():
    emap = mapped()
    cloud, T = scan(5)
    results = []
    for run in (core(emap), torch.compile(core(emap), fullgraph=True, backend="aot_eager")):
        points = cloud.clone().requires_grad_()
        after = run(snapshot(emap), points, T, T, torch.full((2,), 0.1))
        bounds = after.upper_bound[after.bounded & ~after.validity]
        (after.elevation.sum() + bounds.square().sum()).backward()
        results.append(points.grad)
    torch.testing.assert_close(*results)


PARTS = len(Graphs._fields)  # of an update, a graph each


def test_an_older_torch_is_refused(monkeypatch):
    monkeypatch.setattr(torch, "__version__", torch.torch_version.TorchVersion("2.9.1"))
    emap = small_map(1)
    with pytest.raises(RuntimeError, match=r"torch.*2\.10 or later.*2\.9\.1.*upgrade"):
        emap.compile()
    cloud, T = scan(0, 1)
    emap.update(cloud, T, dt=0.0)
    assert emap.validity.any()


@pytest.mark.slow(6)
def test_the_core_exports():
    emap, (cloud, T) = mapped(), scan(5)

    class Core(torch.nn.Module):
        def forward(self, points, T, dt):
            return emap(emap.state, emap.measure(points, T, T, dt)).elevation

    inputs = (cloud, T, torch.full((2,), 0.1))
    exported = torch.export.export(Core(), inputs, strict=False).module()
    torch.testing.assert_close(exported(*inputs), Core()(*inputs))


@pytest.mark.slow(119)
def test_compiled_update_equals_eager_without_what_may_be_left_out():
    """By the real compiler too: one robot, two sensors, variances, no base pose, no drift, no overlap."""
    torch._dynamo.reset()
    maps = [small_map(1, drift=None, overlap=None) for _ in range(2)]
    maps[1].compile()
    for k in range(3):
        cloud, T = scan(k, 1, 60)
        clouds, poses = cloud.unflatten(1, (2, -1)), T[:, None].repeat(1, 2, 1, 1)
        for emap in maps:
            emap.update(clouds, poses, None, 0.3, variance=clouds[..., 0].abs() * 1e-3 + 1e-4)
        # The roughness of ground that few cells tell is the root of a rounding error.
        assert_close(maps[0].state, maps[1].state, 1e-5, skip=["traversability"])
        torch.testing.assert_close(maps[1].state.traversability, maps[0].state.traversability, atol=1e-3, rtol=0)
    assert maps[0].validity.any() and maps[0].bounded.any()


@pytest.mark.slow(7)
def test_an_update_that_is_stopped_leaves_a_sound_map(compile_with, monkeypatch):
    """By an error of the second graph: the window has moved, nothing was taken in, and the next scan is."""
    compile_with("eager")
    emap, eager = small_map(2), small_map(2)
    emap.compile()
    cloud, T = scan(0)

    def stopped(*_):
        raise KeyboardInterrupt

    with monkeypatch.context() as patch:
        name = "torchelev.compiled.update.graphs_of"
        patch.setattr(name, lambda *key: graphs_of(*key)._replace(fuse_heights=stopped))
        with pytest.raises(KeyboardInterrupt):
            emap.update(cloud, T, T, 0.3)
    assert not emap.validity.any()
    eager.update(cloud[:, :0], T, T, 0.3)  # as a scan without points
    for k, number in enumerate((200, 300)):
        cloud, T = scan(k + 1, 2, number)
        for one in (emap, eager):
            one.update(cloud, T, T, 0.3)
    assert_close(eager.state, emap.state, 1e-5)


def test_layers_that_are_not_contiguous_are_refused_before_anything_changes():
    """Operators write into them where they are stored."""
    emap = mapped()
    emap.compile()
    values = emap.state_dict()
    values["elevation"] = values["elevation"].mT.contiguous().mT
    emap.load_state_dict(values, assign=True)
    before = snapshot(emap)
    cloud, T = scan(5)
    with pytest.raises(ValueError, match="contiguous layers.*elevation"):
        emap.update(cloud, T, T, 0.3)
    assert not differences(emap.state, before)


PLAIN = {"drift": None, "raycast": None, "overlap": None, "traversability": None}  # quick to trace


@pytest.mark.slow(10)
@torch._dynamo.config.patch(recompile_limit=2)
def test_configs_of_one_shape_have_their_own_graphs(compile_with):
    """More than the graphs that the compiler keeps of one code object; it refuses the next."""
    compile_with("eager")
    cloud, T = scan(0, 2, 60)
    for k in range(3):
        maps = [small_map(2, **PLAIN, sensor=SensorConfig(noise_floor=1e-4 * (k + 1))) for _ in range(2)]
        maps[1].compile()
        for emap in maps:
            emap.update(cloud, T, T, 0.3)
        assert_close(maps[0].state, maps[1].state)


@pytest.mark.slow(20)
@torch._dynamo.config.patch(recompile_limit=2)
def test_inputs_of_every_kind_have_their_own_graphs(compile_with):
    """Of one config: precisions, sensors, with and without base and variances, numbers of robots."""
    compile_with("eager")
    kinds = [(2, 1, torch.float32, *given) for given in itertools.product((True, False), repeat=2)]
    for num_envs, sensors, dtype, has_base, has_variance in (
        *kinds,
        (5, 2, torch.float64, True, True),
        (3, 1, torch.bfloat16, False, True),
    ):
        cloud, T = scan(0, num_envs, 60)
        clouds = cloud.to(dtype)[:, None].repeat(1, sensors, 1, 1)
        variance = clouds[..., 0].abs() + 0.01 if has_variance else None
        maps = [small_map(num_envs, **PLAIN) for _ in range(2)]
        maps[1].compile()
        for emap in maps:
            base = T if has_base else None
            emap.update(clouds, T[:, None].repeat(1, sensors, 1, 1), base, 0.3, variance=variance)
        assert_close(maps[0].state, maps[1].state)


@pytest.mark.slow(10)
def test_an_update_that_compiles_says_what_it_costs(compile_with, capsys):
    counter = CompileCounter()
    compile_with(counter)
    for number, num_envs in enumerate((2, 2, 3, 5, 1, 7, 2)):
        emap = small_map(num_envs, **PLAIN)
        emap.compile()
        cloud, T = scan(number, num_envs)
        before = counter.frame_count
        emap.update(cloud, T, T, 0.1)
        assert capsys.readouterr().err.count("compiling the update") == (counter.frame_count > before)
    assert counter.frame_count == 3 * PARTS  # of 2, of 2 and more, of 1


@pytest.mark.slow(5)
def test_what_is_compiled_anew_says_so(compile_with, capsys):
    compile_with("eager")
    emap = small_map(2, **PLAIN)
    emap.compile()
    cloud, T = scan(0, 2)
    for _ in range(2):
        torch._dynamo.reset()
        emap.update(cloud, T, T, 0.1)
        assert capsys.readouterr().err.count("compiling the update") == 1
    assert not callback_handler.start_callbacks


@pytest.mark.slow(8)
@pytest.mark.parametrize("sensors, with_variance", [(None, False), (2, True)])
def test_a_new_number_of_points_compiles_nothing(compile_with, sensors, with_variance):
    """The same graphs for every number of points from 2 on, with the statistics and the map of the eager update."""
    counter = CompileCounter()
    compile_with(counter)
    eager, compiled = small_map(2, drift=None), small_map(2, drift=None)
    compiled.compile()
    for k, number in enumerate((300, 290, 2, 310, 64, 65, 3, 1000)):
        cloud, T = scan(k, 2, number * (sensors or 1))
        variance = torch.full(cloud.shape[:-1], 1e-3)
        T_sensor = T
        if sensors:
            cloud, variance = (v.unflatten(1, (sensors, number)) for v in (cloud, variance))
            T_sensor = T[:, None].repeat(1, sensors, 1, 1)
        for emap in (eager, compiled):
            emap.update(cloud, T_sensor, T, 0.1, variance=variance if with_variance else None)
        assert differences(eager.state, compiled.state) == [], number
        assert counter.frame_count == PARTS, number


@pytest.mark.parametrize("sensors", [None, 2])
def test_clouds_of_no_or_one_point_run_eagerly(compile_with, sensors):
    """The compiler takes sizes 0 and 1 for constants; they must not cost a graph each."""
    counter = CompileCounter()
    compile_with(counter)
    eager, compiled = small_map(2), small_map(2)
    compiled.compile()
    for number in (0, 1):
        cloud, T = scan(number, 2, number * (sensors or 1))
        T_sensor = T
        if sensors:
            cloud, T_sensor = cloud.unflatten(1, (sensors, number)), T[:, None].repeat(1, sensors, 1, 1)
        for emap in (eager, compiled):
            emap.update(cloud, T_sensor, T, 0.1)
            emap.update(cloud, T_sensor, T, 0.1, variance=torch.full(cloud.shape[:-1], 1e-3))
        assert differences(eager.state, compiled.state) == []
    assert compiled.validity.any() and counter.frame_count == 0


@pytest.mark.slow(3)
def test_maps_of_equal_configs_share_their_graphs(compile_with):
    counter = CompileCounter()
    compile_with(counter)
    maps = small_map(2, **PLAIN), small_map(2, **PLAIN)
    for k, emap in enumerate(maps):
        emap.compile()
        cloud, T = scan(k, 2, 300 + k)
        emap.update(cloud, T, T, 0.1)
    assert counter.frame_count == PARTS


@pytest.mark.slow(5)
def test_inference_mode_shares_the_graphs(compile_with):
    """Training steps environments in inference mode, and tries them outside."""
    counter = CompileCounter()
    compile_with(counter)
    emap = small_map(2)
    emap.compile()
    for k, mode in enumerate((False, True, False)):
        cloud, T = scan(k, 2)
        with torch.inference_mode(mode):
            emap.update(cloud + 0.0, T + 0.0, T, 0.1)
    assert counter.frame_count == PARTS and emap.validity.any()


def test_equal_configs_share_the_compiled_update():
    assert graphs_of(small_config(), (), 1) is graphs_of(small_config(), (), 1)
    assert graphs_of(small_config(), (), 1) is not graphs_of(small_config(drift=None), (), 1)


@pytest.mark.slow(3)
def test_no_recompilation_for_new_values():
    """New dt, poses and clouds are data, not constants."""
    emap, counter = mapped(), CompileCounter()
    torch._dynamo.reset()
    compiled = torch.compile(core(emap), fullgraph=True, backend=counter)
    for k in range(4):
        cloud, T = scan(k)
        compiled(snapshot(emap), cloud, T, T, torch.full((2,), 0.1 * k))
    assert counter.frame_count == 1


@pytest.mark.slow(6)
@pytest.mark.parametrize(
    "num_envs, chunk, sensors, base, variance",
    [(2, None, 1, True, False), (1, None, 2, False, True), (5, 2, 1, True, False)],
)
def test_warm_maps_compile_nothing_more_and_are_untouched(compile_with, num_envs, chunk, sensors, base, variance):
    counter = CompileCounter()
    compile_with(counter)
    emap = ElevationMap(small_config(**PLAIN), num_envs=num_envs, chunk=chunk)
    cloud = torch.randn(num_envs, sensors, 50, 3, generator=torch.Generator().manual_seed(0))
    T = torch.eye(4, dtype=torch.float64).repeat(num_envs, sensors, 1, 1)
    given = dict(variance=torch.full(cloud.shape[:-1], 0.01) if variance else None)
    emap.update(cloud, T, T[:, 0] if base else None, dt=0.1, **given)
    before = snapshot(emap)
    emap.warm_up(50, sensors, base=base, variance=variance)
    assert counter.frame_count == 0, "a map that is not compiled has nothing to warm up"
    emap.compile()
    emap.warm_up(50, sensors, base=base, variance=variance)
    assert counter.frame_count >= PARTS
    assert differences(before, emap.state) == []
    count = counter.frame_count
    for points in (cloud, cloud[:, :, :40]):
        values = None if not variance else given["variance"][:, :, : points.shape[2]]
        emap.update(points, T, T[:, 0] if base else None, dt=0.1, variance=values)
    assert counter.frame_count == count


@pytest.mark.parametrize("numbers, name", [((0,), "num_points"), ((5, 0), "num_sensors"), ((2.5,), "num_points")])
def test_warm_up_refuses_what_no_update_takes(numbers, name):
    with pytest.raises((ValueError, TypeError), match=name):
        mapped().warm_up(*numbers)
