"""Sensors that disagree in height: the variance covers it, and heights are fused as if nothing were added."""

import copy

import numpy as np
import pytest
import torch

from tests.helpers import snapshot
from torchelev import DriftConfig, ElevationMap, ElevationMapConfig, GridConfig, LearnedTraversabilityConfig
from torchelev.io.map_file import load_map, save_map

GRID = GridConfig(resolution=0.05, length_x=4.0, length_y=4.0)
T = torch.eye(4, dtype=torch.float64)[None]


def clouds(bias, count=2, num_scans=30, slope=0.0, seed=0):
    """Clouds (1, S, N, 3) of sensors 0.6 m above the ground, the last `bias` [m] too high."""
    generator = torch.Generator().manual_seed(seed)
    for _ in range(num_scans):
        points = 4 * torch.rand(1, count, 6000, 3, generator=generator) - 2
        points[..., 2] = slope * points[..., 0] - 0.6 + 0.005 * torch.randn(1, count, 6000, generator=generator)
        points[:, -1, :, 2] += bias
        yield points


def in_one_call(scans, **cfg):
    emap = ElevationMap(ElevationMapConfig(grid=GRID, **cfg))
    for points in scans:
        emap.update(points, T[:, None].repeat(1, points.shape[1], 1, 1), T, dt=0.1)
    return emap


def in_turns(scans, **cfg):
    emap = ElevationMap(ElevationMapConfig(grid=GRID, **cfg))
    for points in scans:
        for s in range(points.shape[1]):
            emap.update(points[:, s], T, T, dt=0.1 if s == 0 else 0.0)
    return emap


def claimed(emap):
    """Return the median standard deviation [m] of the known cells."""
    return float(emap.layer("variance")[emap.validity[None].squeeze(0)].sqrt().median())


@pytest.mark.slow(1)
@pytest.mark.parametrize("bias", [0.02, 0.05, 0.1])
@pytest.mark.parametrize("slope", [0.0, 0.3])
def test_two_sensors_of_one_call(bias, slope):
    """Their height is half-way; the standard deviation of two values b apart is b / sqrt(2)."""
    emap = in_one_call(clouds(bias, slope=slope))
    assert claimed(emap) == pytest.approx(bias / 2**0.5, rel=0.05)
    assert float(emap.statistics.disagreement) == pytest.approx(bias / 2**0.5, rel=0.05)
    assert claimed(in_one_call(clouds(bias, num_scans=1, slope=slope))) >= 0.9 * bias / 2**0.5, "from the first scan on"
    assert claimed(in_one_call(clouds(bias, slope=slope), drift=None)) == pytest.approx(bias / 2**0.5, rel=0.05)


@pytest.mark.parametrize("native", ["0", "1"])
@pytest.mark.parametrize("shared, disagreement", [(19, 0.0), (20, 0.05 / 2**0.5)])
def test_sensors_count_from_twenty_shared_cells_on(native, shared, disagreement, monkeypatch):
    monkeypatch.setenv("TORCHELEV_NATIVE", native)
    emap = ElevationMap(ElevationMapConfig(grid=GRID))
    points = torch.full((1, 2, 30, 3), torch.nan)
    for s, first in enumerate((0, 30 - shared)):  # 30 cells in a row for each sensor
        x = 0.05 * (torch.arange(30) + first) - 1.475
        points[0, s] = torch.stack([x, torch.full_like(x, 0.025), torch.full_like(x, 0.05 * s - 0.6)], -1)
    emap.update(points, T[:, None].repeat(1, 2, 1, 1), T, dt=0.1)
    assert float(emap.statistics.disagreement) == pytest.approx(disagreement, abs=1e-6)


@pytest.mark.parametrize("count, share", [(2, 1.0), (3, 3**-0.5)])
@pytest.mark.parametrize("bias", [0.02, 0.05])
def test_sensors_that_take_turns(bias, count, share):
    """Of two, each scan moves the map by the bias; of three, one is off: their standard deviation is b / sqrt(3)."""
    emap = in_turns(clouds(bias, count))
    assert claimed(emap) == pytest.approx(share * bias, rel=0.35)


def test_sensors_that_agree_add_nothing():
    for emap in (in_one_call(clouds(0.0)), in_turns(clouds(0.0))):
        assert float(emap.statistics.disagreement) < 5e-4 and claimed(emap) < 0.003


def test_noise_of_the_poses_is_estimated_and_steady_drift_is_none():
    def mapped(height_of):
        emap = ElevationMap(ElevationMapConfig(grid=GRID))
        for k, points in enumerate(clouds(0.0, count=1, num_scans=120)):
            emap.update(points[:, 0] + torch.tensor([0.0, 0, height_of(k)]), T, T, dt=0.1)
            if k > 40:
                found.append(float(emap.statistics.disagreement) ** 2)

    found: list[float] = []
    noise = 0.01 * torch.randn(120, generator=torch.Generator().manual_seed(1))
    mapped(lambda k: float(noise[k]))
    assert sum(found) / len(found) == pytest.approx(0.01**2, rel=0.4)
    found.clear()
    mapped(lambda k: 0.01 * k)
    assert max(found) == 0.0


def test_heights_are_those_of_relative_variances(monkeypatch):
    """What is added to the variance on the way out is taken off on the way in."""
    emap = in_turns(clouds(0.05, num_scans=6))
    for name in ("subtract", "add"):
        monkeypatch.setattr(f"torchelev.pipeline.{name}_disagreement", lambda state: state)
    monkeypatch.setenv("TORCHELEV_NATIVE", "0")
    plain = in_turns(clouds(0.05, num_scans=6))
    torch.testing.assert_close(emap.elevation, plain.elevation, atol=1e-6, rtol=0)
    added = emap.variance - plain.variance
    torch.testing.assert_close(
        added[emap.validity], emap.statistics.disagreement.square().expand(int(emap.validity.sum())), atol=1e-7, rtol=0
    )


def test_forward_is_update():
    emap, pure = in_one_call(clouds(0.05, num_scans=3)), ElevationMap(ElevationMapConfig(grid=GRID))
    state = snapshot(pure)
    for points in clouds(0.05, num_scans=3):
        state = pure(state, pure.measure(points, T[:, None].repeat(1, 2, 1, 1), T, dt=0.1))
    torch.testing.assert_close(state.variance, emap.variance, atol=1e-7, rtol=1e-4)
    emap.reset()
    assert float(emap.statistics.disagreement) == 0.0


def test_a_drift_that_is_not_corrected_leaves_it_as_it_was():
    emap = in_turns(clouds(0.05, num_scans=8))
    before = emap.statistics.disagreement
    emap.update(torch.full((1, 1, 3), torch.nan), T, T, dt=0.1)
    assert torch.equal(emap.statistics.disagreement, before)
    assert DriftConfig().min_points > 1


def updated(emap, points):
    emap.update(points, T[:, None].repeat(1, points.shape[1], 1, 1), T, dt=0.1)
    return emap.variance.clone()


def test_a_checkpoint_goes_on_as_its_map():
    """Loaded where nothing, or something else, disagrees."""
    *scans, last = clouds(0.05, num_scans=4)
    emap = in_one_call(scans)
    checkpoint = copy.deepcopy(emap.state_dict())
    expected = updated(emap, last)
    for other in (ElevationMap(emap.cfg), in_one_call(clouds(0.1, num_scans=3))):
        other.load_state_dict(checkpoint)
        assert torch.equal(updated(other, last), expected)


def test_checkpoints_and_files_from_before_disagree_by_nothing(tmp_path):
    emap = in_one_call(clouds(0.0, num_scans=2))
    checkpoint = {name: value for name, value in emap.state_dict().items() if not name.startswith("last_")}
    other = in_one_call(clouds(0.05, num_scans=2))
    other.load_state_dict(checkpoint)
    assert float(other.statistics.disagreement) == 0.0
    save_map(tmp_path / "new.npz", emap)
    with np.load(tmp_path / "new.npz") as file:
        np.savez(tmp_path / "old.npz", **{name: file[name] for name in file.files if name != "last_disagreement"})
    loaded = load_map(tmp_path / "old.npz")
    assert float(loaded.statistics.disagreement) == 0.0 and torch.equal(loaded.variance, emap.variance)


def test_cells_that_feet_initialise_get_the_disagreement_too():
    emap = in_one_call(p[..., p[0, 0, :, 0] < 0, :] for p in clouds(0.05, count=2, num_scans=2))
    unknown = ~emap.validity
    emap.initialize(torch.tensor([[[1.0, 1.0, -0.6]]]), "nearest")
    expected = emap.cfg.fusion.max_variance + float(emap.statistics.disagreement) ** 2
    torch.testing.assert_close(emap.variance[unknown], torch.full_like(emap.variance[unknown], expected))


def test_ratings_read_anew_are_those_of_the_update():
    emap = in_one_call(clouds(0.05, num_scans=2), traversability=LearnedTraversabilityConfig())
    known = emap.validity
    torch.testing.assert_close(emap.rate().traversability[known], emap.traversability[known], atol=1e-4, rtol=0)
