"""The heads that a learned one is compared with."""

import math

import numpy as np
import pytest
import torch

from torchelev.robot import RobotConfig
from training.traversability.heads import analytic, as_mapped, baselines, family, lowest_under_body, paper, resize
from training.traversability.maps.data import MappedTerrain


def mapped(elevation, validity=None, resolution=0.1, robot=None):
    """A map without bounds whose labels do not matter."""
    zero = torch.zeros_like(elevation)
    validity = torch.ones_like(elevation, dtype=torch.bool) if validity is None else validity
    rated = torch.ones_like(validity)
    return MappedTerrain(
        elevation, validity, zero, zero, ~rated, zero, rated, resolution, robot or RobotConfig(), ("flat",)
    )


def test_the_lowest_under_the_body_equals_a_loop():
    rng = np.random.default_rng(0)
    score, known = torch.from_numpy(rng.random((2, 11, 8))), torch.from_numpy(rng.random((2, 11, 8)) < 0.8)
    maps = mapped(score, known, 0.1, RobotConfig(width=0.64, length=0.7))  # 3.2 cells
    found = lowest_under_body(score, known, maps)
    for b in range(2):
        for i in range(11):
            for j in range(8):
                around = [
                    float(score[b, k, n])
                    for k in range(11)
                    for n in range(8)
                    if math.hypot(i - k, j - n) <= 3 and known[b, k, n]
                ]
                expected = min(around) if known[b, i, j] else 0.0
                assert float(found[b, i, j]) == pytest.approx(expected), (b, i, j)


def test_the_analytic_head_takes_the_robots_slope():
    x = torch.arange(20) * 0.1
    maps = mapped((0.3 * x)[None, :, None].expand(1, 20, 20).contiguous(), robot=RobotConfig(max_slope=1.4))
    default, of_robot = (analytic(maps, as_mapped(maps), flag)[0, 10, 10] for flag in (False, True))
    slope = math.atan(0.3)
    assert float(default) == pytest.approx(1 - slope / 0.7, abs=1e-4)
    assert float(of_robot) == pytest.approx(1 - slope / 1.4, abs=1e-4)


def test_baselines_rate_unknown_cells_zero_unless_they_fill_them():
    known = torch.ones(1, 30, 30, dtype=torch.bool)
    known[:, 10:14, 10:14] = False
    maps = mapped(torch.zeros(1, 30, 30), known)
    heads = baselines()
    assert {family(name) for name in heads} == {"analytic", "analytic on filled"} and len(heads) == 8
    for name, score in heads.items():
        rated = score(maps)
        assert rated.shape == (1, 30, 30) and float(rated[known].amin()) > 0.99, name
        expected = 1.0 if family(name) == "analytic on filled" else 0.0
        assert float(rated[~known].mean()) == pytest.approx(expected, abs=0.01), name


def test_resizing_keeps_means_and_slopes():
    x = torch.arange(24.0)[None, :, None].expand(1, 24, 24)
    down = resize(x, (12, 12))
    assert float(down[0, 6, 6]) == pytest.approx(12.5) and float(down[0, 3, 0]) == pytest.approx(6.5)
    assert torch.equal(resize(x, (24, 24)), x)


def test_the_papers_filter_sees_filled_heights_at_its_own_resolution():
    seen = []

    def net(heights):
        seen.append(heights)
        return torch.full_like(heights, 0.7)

    heights = torch.full((2, 20, 20), 3.0)
    known = torch.ones(2, 20, 20, dtype=torch.bool)
    known[0, 5:9, 5:9] = False
    known[1] = False
    maps = mapped(torch.where(known, heights, 99.0), known, resolution=0.08)
    as_is, resampled = (paper(maps, net, flag) for flag in (False, True))
    assert [tuple(z.shape) for z in seen] == [(2, 26, 26), (2, 46, 46)], "with a rim of 3 cells"
    for z in seen:
        torch.testing.assert_close(z[0], torch.full_like(z[0], 3.0), atol=1e-3, rtol=0)
    for rated in (as_is, resampled):
        assert rated.shape == known.shape and not rated[1].any()
        torch.testing.assert_close(rated[0], torch.full_like(rated[0], 0.7))


def test_the_papers_filter_takes_part_if_its_weights_are_given(tmp_path):
    rng = np.random.default_rng(0)
    banks = {f"conv{k}.weight": rng.normal(size=(4, 1, 3, 3)).astype(np.float32) for k in (1, 2, 3)}
    banks = {name: bank - bank.mean((2, 3), keepdims=True) for name, bank in banks.items()}  # blind to altitude
    np.savez(tmp_path / "weights.npz", **banks, **{"conv_final.weight": np.ones((1, 12, 1, 1), np.float32)})
    heads = baselines(tmp_path / "weights.npz")
    assert len(heads) == 8 + 4 and {family(name) for name in heads} >= {"paper"}
    flat = mapped(torch.full((1, 20, 20), 2.0))
    step = flat._replace(elevation=flat.elevation + (torch.arange(20.0) >= 10))
    for name in ("paper (as is)", "paper (at 4 cm)", "paper (as is, footprint)", "paper (at 4 cm, footprint)"):
        torch.testing.assert_close(heads[name](flat), torch.ones(1, 20, 20), atol=1e-3, rtol=0)
        assert float(heads[name](step)[0, 10, 10]) < 0.1 < 0.9 < float(heads[name](step)[0, 10, 2]), name
    with pytest.raises(FileNotFoundError):
        baselines(tmp_path / "none.npz")


def test_the_papers_filter_rates_each_cell_at_its_place():
    heights = torch.rand(1, 12, 9, generator=torch.Generator().manual_seed(0))
    maps = mapped(heights, resolution=0.04)
    for resampled in (False, True):
        torch.testing.assert_close(paper(maps, lambda z: z / 2, resampled), heights / 2)
