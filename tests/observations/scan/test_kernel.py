"""Height scans in C++: the same values as by tensors, and taken only where nothing is differentiated."""

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from torch.autograd import forward_ad
from torch.fx.experimental.proxy_tensor import make_fx

from tests.observations.maps import SEEDS, random_base, random_map
from torchelev import ElevationMap
from torchelev.kernels.cpu_build import find_compiler, is_switched_off
from torchelev.observations.fill import FILLS, MODES, ORIGINAL
from torchelev.observations.height_scan import HeightScan
from torchelev.observations.inputs import ScanInputs
from torchelev.observations.patterns import ALIGNMENTS
from torchelev.observations.scan.kernel import can_read
from torchelev.observations.scan.presets import PRESETS
from torchelev.state import map_layers

HAS_CPP = find_compiler() is not None and not is_switched_off()
needs_cpp = pytest.mark.skipif(not HAS_CPP, reason="needs a C++ compiler")
SIZES = st.sampled_from([(22, 21), (64, 40), (90, 71)])
FAST_FILLS = [*FILLS, ORIGINAL, 0.35]


def require_same(monkeypatch, scan, *arguments, noise=False):
    """Compare a scan in C++ with that by tensors."""
    fast = scan(*arguments, noise=noise)
    with monkeypatch.context() as patch:
        patch.setenv("TORCHELEV_NATIVE", "0")
        values, valid = scan(*arguments, noise=noise)
    assert torch.equal(fast[1], valid) and fast[1].dtype == torch.bool
    torch.testing.assert_close(fast[0], values, atol=1e-6 * scan.scale, rtol=1e-6)
    return values


@needs_cpp
@pytest.mark.parametrize("fill", FAST_FILLS)
@pytest.mark.parametrize("name", PRESETS)
@given(seed=SEEDS, size=SIZES, known=st.sampled_from([0.003, 0.1, 0.6, 0.95]), single=st.booleans())
def test_presets_read_the_same_in_cpp(name, fill, monkeypatch, seed, size, known, single):
    emap, rng = random_map(seed, known=known, cells=size, dtype=torch.float32)
    T = random_base(emap, rng)
    T[:, 2, 3] -= rng.uniform(0, 1)  # on some maps, ground lies above the base
    T = T.to(torch.float32 if single else torch.float64)
    require_same(monkeypatch, HeightScan.preset(name, fill=fill), emap, T, noise=torch.rand(2, 187))


@needs_cpp
@pytest.mark.parametrize("fill", FAST_FILLS)
@given(SEEDS, SIZES, st.sampled_from(MODES), st.sampled_from(ALIGNMENTS), st.integers(0, 7))
def test_scans_around_feet_read_the_same_in_cpp(fill, monkeypatch, seed, size, mode, alignment, rings):
    """Also of a foot whose position is not known, or beyond the window, and of a base that lies on its side."""
    emap, rng = random_map(seed, known=0.5, cells=size, dtype=torch.float32)
    T = random_base(emap, rng, tilt=1.5)
    feet = T[:, None, :3, 3] + torch.from_numpy(rng.uniform(-0.3, 0.3, (2, 5, 3)))
    feet[0, 1, seed % 3], feet[1, 3, :2] = torch.nan, 50.0
    settings = dict(fill=fill, mode=mode, alignment=alignment, inpaint_rings=rings, standing_height=0.4)
    require_same(monkeypatch, HeightScan.feet(num_feet=5, reach=0.3, **settings), emap, T, feet)


@needs_cpp
def test_threads_share_many_robots():
    emap, rng = random_map(0, num_envs=1, dtype=torch.float32, cells=(30, 30))
    T, scan = torch.cat([random_base(emap, rng) for _ in range(50)]), HeightScan.isaac_lab()
    many = ElevationMap(emap.cfg, 50)
    many.load_state(map_layers(lambda value: value.expand(50, *value.shape[1:]), emap.state))
    torch.set_num_threads(2)
    values, valid = scan(many, T)
    for b in range(50):
        assert all(map(torch.equal, scan(emap, T[b : b + 1]), (values[b : b + 1], valid[b : b + 1])))


# When it runs ---------------------------------------------------------------------------------------------------------


def inputs_of(dtype=torch.float32):
    emap, rng = random_map(1, dtype=dtype)
    return ScanInputs(emap.state, emap.cfg.grid, random_base(emap, rng), None, None)


def in_state(inputs, **layers):
    return inputs._replace(state=inputs.state._replace(**layers))


def test_without_a_compiler_tensors_read(monkeypatch):
    inputs = inputs_of()
    assert can_read("ground", inputs) == HAS_CPP
    monkeypatch.setenv("TORCHELEV_NATIVE", "0")
    assert not can_read("ground", inputs)


@needs_cpp
def test_cpp_reads_float32_without_gradients():
    inputs, double = inputs_of(), inputs_of(torch.float64)
    heights, T = inputs.state.elevation.clone().requires_grad_(), inputs.T_map_base.clone().requires_grad_()
    draws, few = torch.rand(2, 187), inputs.state.validity[:1]
    assert all(can_read(fill, inputs._replace(draws=draws)) for fill in FAST_FILLS)
    others = [
        double,
        inputs._replace(draws=draws.double()),
        inputs._replace(draws=draws.requires_grad_()),
        inputs._replace(T_map_base=T),
        inputs._replace(feet=T[:, None, :3, 3]),
        in_state(inputs, elevation=heights),
        in_state(inputs, upper_bound=heights),
        in_state(inputs, validity=few),  # which tensors refuse
    ]
    assert not any(can_read("ground", other) for other in others)
    with torch.no_grad():
        assert can_read("ground", in_state(inputs, elevation=heights)._replace(T_map_base=T))


@needs_cpp
@pytest.mark.filterwarnings("ignore:.*torch.jit.trace:DeprecationWarning")
def test_tensors_read_while_torch_records():
    inputs, seen = inputs_of(), []

    def read(x):
        seen.append(can_read("ground", inputs))
        return 2 * x

    read(torch.ones(1))
    torch.func.grad(read)(torch.tensor(1.0))
    torch.func.vmap(read)(torch.ones(2))
    make_fx(read)(torch.ones(2))
    torch.jit.trace(read, torch.ones(2), check_trace=False)
    with forward_ad.dual_level():
        read(torch.ones(1))
    torch.compile(read, backend="eager")(torch.ones(2))
    assert seen == [True, *[False] * 6]


@pytest.mark.parametrize("fill", ["ground", "upper_bound", "inpaint"])
def test_gradients_of_float32_maps(fill):
    emap, rng = random_map(2, dtype=torch.float32)
    T, heights = random_base(emap, rng), emap.elevation.nan_to_num().requires_grad_()

    def read(heights):
        scan = HeightScan.points([(0.1, 0.2), (-0.3, 0.1), (0.2, -0.2)], fill=fill)
        return scan(emap, T, state=emap.state._replace(elevation=heights))[0].sum()

    (grad,) = torch.autograd.grad(read(heights), heights)
    assert grad.any()
    torch.testing.assert_close(torch.func.grad(read)(heights.detach()), grad)
