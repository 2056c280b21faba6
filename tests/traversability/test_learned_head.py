"""The learned head in the map: what the config names runs, compiled or not, and gradients reach its weights."""

import copy
import dataclasses
from pathlib import Path

import pytest
import torch
from torch._subclasses.fake_tensor import FakeTensorMode

from torchelev import ElevationMap, ElevationMapConfig, GridConfig, LearnedTraversabilityConfig, RobotConfig
from torchelev.io.map_file import load_map, save_map
from torchelev.pipeline import rate
from torchelev.state import blank_state
from torchelev.traversability.heads import TraversabilityConfig, TraversabilityNet
from torchelev.traversability.weight_file import Weights, weight_shapes

GRID = GridConfig(resolution=0.1, length_x=3.0, length_y=2.6)


@pytest.fixture
def weights(tmp_path):
    torch.manual_seed(3)
    path = tmp_path / "head.pt"
    TraversabilityNet().save(path)
    return str(path)


@pytest.fixture
def cfg(weights):
    return ElevationMapConfig(grid=GRID, traversability=LearnedTraversabilityConfig(weights=weights))


def look(emap, seed=0):
    """Two clouds over a bumpy floor, seen from above, and nothing beyond x = 1."""
    generator = torch.Generator().manual_seed(seed)
    B = emap.num_envs
    xy = torch.rand(B, 4000, 2, generator=generator) * torch.tensor([2.5, 2.6]) - torch.tensor([1.5, 1.3])
    z = 0.2 * (torch.sin(3 * xy[..., 0]) > 0) - 1.0
    T = torch.eye(4).repeat(B, 1, 1)
    for _ in range(2):
        emap.update(torch.cat([xy, z[..., None]], -1), T, T, dt=0.1)


def test_the_map_rates_as_the_net_does(cfg):
    emap = ElevationMap(cfg, num_envs=2)
    look(emap)
    state = emap.state
    layers = state.elevation, state.validity, state.variance, state.upper_bound, state.bounded
    expected = TraversabilityNet.from_pretrained(cfg.traversability.weights)(
        *layers, resolution=0.1, robot=RobotConfig()
    )
    assert torch.equal(state.traversability, expected.traversability)
    rating = emap.rate()
    assert torch.equal(rating.traversability, expected.traversability)
    assert torch.equal(rating.confidence, expected.confidence)
    assert expected.traversability.std() > 0.001
    layer = emap.layer("traversability")
    assert torch.equal(layer.isnan(), ~state.validity) and state.validity.any() and not state.validity.all()


def test_the_analytic_head_rates_under_the_same_interface():
    emap = ElevationMap(ElevationMapConfig(grid=GRID), num_envs=2)
    look(emap)
    rating, known = emap.rate(), emap.state.validity
    torch.testing.assert_close(rating.traversability[known], emap.layer("traversability")[known], atol=2e-3, rtol=0)
    assert (rating.traversability[~known] == 0).all() and torch.equal(rating.confidence, known.float())


def test_gradients_reach_weights_and_elevation(cfg):
    emap = ElevationMap(cfg, num_envs=1)
    look(emap)
    emap.head.requires_grad_(True)
    state = emap.state
    elevation = state.elevation.clone().requires_grad_()
    rating = emap.rate(state=state._replace(elevation=elevation))
    (rating.traversability.sum() + rating.confidence.sum()).backward()
    assert elevation.grad.isfinite().all() and (elevation.grad[~state.validity] == 0).all()
    assert elevation.grad.abs().sum() > 0
    assert all(p.grad.isfinite().all() for p in emap.head.parameters())
    look(emap)  # an update builds no graph
    assert not emap.state.traversability.requires_grad


def test_weights_may_be_named_by_a_path_or_its_text():
    named = LearnedTraversabilityConfig(weights=Path("some") / "weights.pt")
    assert named == LearnedTraversabilityConfig(weights=str(Path("some/weights.pt")))


def test_config_round_trip_and_what_is_refused(cfg, tmp_path):
    assert ElevationMapConfig.from_dict(cfg.to_dict()) == cfg
    analytic = ElevationMapConfig.from_dict({"traversability": {"radius": 0.2}})
    assert analytic.traversability == TraversabilityConfig(radius=0.2)
    assert ElevationMapConfig.from_dict({"traversability": {}}).traversability == TraversabilityConfig()
    robot = ElevationMapConfig.from_dict({"traversability": {"robot": {"length": 0.8}}}).traversability.robot
    assert robot == RobotConfig(length=0.8)
    with pytest.raises(ValueError, match="config.traversability.leg.*is not a setting"):
        ElevationMapConfig.from_dict({"traversability": {"leg": 2}})
    with pytest.raises(ValueError, match="robot.leg.*is not a setting"):
        ElevationMapConfig.from_dict({"traversability": {"robot": {"leg": 2}}})
    with pytest.raises(TypeError, match="traversability.robot: must be a RobotConfig"):
        LearnedTraversabilityConfig(robot={"length": 0.7})
    with pytest.raises(FileNotFoundError, match="must be a file of weights"):
        ElevationMap(ElevationMapConfig(traversability=LearnedTraversabilityConfig(weights=str(tmp_path / "none.pt"))))
    coarse = GridConfig(resolution=0.2, length_x=4.0, length_y=4.0)
    with pytest.raises(ValueError, match="resolution: must be 0.02 to 0.1 m"):
        ElevationMap(ElevationMapConfig(grid=coarse, traversability=cfg.traversability))
    large = RobotConfig(length=0.7, width=0.1)
    learned = LearnedTraversabilityConfig(robot=large, weights=cfg.traversability.weights)
    with pytest.raises(ValueError, match="robot.width / length: must be within"):
        ElevationMap(ElevationMapConfig(grid=GRID, traversability=learned))
    with pytest.raises(ValueError, match="cfg.traversability: must not be None"):
        ElevationMap(ElevationMapConfig(grid=GRID, traversability=None)).rate()


def test_copies_checkpoints_and_files_carry_the_weights(cfg, tmp_path):
    emap = ElevationMap(cfg, num_envs=2)
    with torch.no_grad():
        emap.head.answer_bias.add_(1.0)
    look(emap)
    elsewhere = str(tmp_path / "elsewhere.pt")
    TraversabilityNet().save(elsewhere)
    learned = LearnedTraversabilityConfig(weights=elsewhere)
    other = ElevationMap(dataclasses.replace(cfg, traversability=learned), num_envs=2)
    other.load_state_dict(emap.state_dict())
    assert torch.equal(other.rate().traversability, emap.rate().traversability)
    assert torch.equal(copy.deepcopy(emap).rate().traversability, emap.rate().traversability)
    alone = TraversabilityNet()  # whatever the batch
    alone.load_state_dict({n[5:]: v for n, v in emap.state_dict().items() if n.startswith("head.")})
    save_map(tmp_path / "map.npz", emap)
    Path(cfg.traversability.weights).unlink()
    assert torch.equal(load_map(tmp_path / "map.npz").rate().traversability, emap.rate().traversability)


def test_a_head_may_be_given(cfg):
    net = TraversabilityNet()
    emap = ElevationMap(cfg, num_envs=1, head=net)
    assert emap.head is net and net.answer.requires_grad
    with pytest.raises(ValueError, match="head: must be None unless the config asks for a trained one"):
        ElevationMap(ElevationMapConfig(grid=GRID), head=net)


@pytest.mark.parametrize("dtype", [torch.float16, torch.bfloat16, torch.float64])
def test_maps_of_other_precision(cfg, dtype):
    emap = ElevationMap(cfg, num_envs=1).to(torch.promote_types(dtype, torch.float32))
    look(emap)
    rating = emap.to(dtype).rate()
    assert emap.state.traversability.isfinite().all() and emap.state.traversability.dtype == dtype
    assert all(part.isfinite().all() and part.dtype == dtype for part in rating)


@pytest.mark.slow(2)
def test_nothing_waits_for_the_device(cfg):
    """On tensors without values."""
    with FakeTensorMode():
        state = rate(
            blank_state(GRID, 2, "cpu", torch.float32),
            cfg,
            Weights(*(torch.zeros(shape) for shape in weight_shapes(12, 8).values())),
        )
    assert state.traversability.shape == (2, 30, 26)


def test_no_known_cell_gives_a_defined_answer(cfg):
    rating = ElevationMap(cfg, num_envs=1).rate()
    for part in rating:
        assert part.isfinite().all() and ((part >= 0) & (part <= 1)).all() and part.unique().numel() == 1
