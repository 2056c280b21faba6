"""Fusing heights into cells, against the slow reference, cell by cell."""

import math

import hypothesis.strategies as st
import numpy as np
import pytest
import torch
from hypothesis import given

from tests import reference
from torchelev.site.fusion.fuse import Entries, Heights, fuse
from torchelev.site.site_config import SiteConfig

CFG = SiteConfig()
LIMITS = dict(gate=CFG.gate, max_gate_std=CFG.max_gate_std, max_newer_ratio=CFG.max_newer_ratio)
NOTHING = dict(h=math.nan, v=math.nan, t=math.nan)


def draw_height(rng, levels, at=None):
    """A height near one of few levels, so that some agree and some contradict each other."""
    return dict(h=rng.choice(levels) + rng.normal(0, 0.002), v=10 ** rng.uniform(-6, -3), t=rng.uniform(0, 50))


def heights(dicts):
    return Heights(*(torch.tensor([d[key] for d in dicts], dtype=torch.float64) for key in ("h", "v", "t")))


def run(first, other, cells, rate=1e-7, cfg=CFG):
    """Fuse lists of entries, one list per cell; None stands for no height."""
    entries = [(c, e) for c, cell in enumerate(cells) for e in cell]
    contributed = heights([e["contributed"] or NOTHING for _, e in entries])
    cell = torch.tensor([c for c, _ in entries], dtype=torch.int64)
    relief = torch.tensor([e["relief"] for _, e in entries], dtype=torch.float64)
    flat = Entries(cell, heights([e for _, e in entries]), relief, contributed)
    return fuse(heights([f or NOTHING for f in first]), heights([o or NOTHING for o in other]), flat, rate, cfg)


def entry(h, v=1e-4, t=10.0, relief=0.0, contributed=None):
    return dict(h=h, v=v, t=t, relief=relief, contributed=contributed)


@pytest.mark.slow(1)
@pytest.mark.parametrize("seed", range(8))
def test_every_cell_is_that_of_the_reference(seed):
    rng = np.random.default_rng(seed)
    first, other, cells = [], [], []
    for _ in range(150):
        levels = [0.0, 0.01, 0.4, -0.3]
        first.append(draw_height(rng, levels) if rng.random() < 0.7 else None)
        other.append(draw_height(rng, levels) if first[-1] and rng.random() < 0.3 else None)
        cell = []
        for _ in range(rng.integers(0, 5)):
            e = {**draw_height(rng, levels), "relief": rng.choice([0.0, 1e-5, 1e-3]), "contributed": None}
            source = other[-1] if other[-1] and rng.random() < 0.4 else first[-1]
            if source and rng.random() < 0.5:
                contributed = {**draw_height(rng, [source["h"]]), "t": min(e["t"], source["t"])}
                contributed["v"] = max(contributed["v"], 1.2 * source["v"])
                e["contributed"] = contributed
            cell.append(e)
        cells.append(cell)
    rate = rng.choice([0.0, 1e-7, 1e-5])
    fused = run(first, other, cells, rate)
    contradicted = {}
    flags = iter(fused.is_contradicted.tolist())
    for c, cell in enumerate(cells):
        contradicted[c] = [next(flags) for _ in cell]
        expected = reference.fuse_site_cell(first[c], other[c], cell, rate, **LIMITS)
        for found, wanted in zip((fused.first, fused.other), expected[:2], strict=True):
            actual = [float(value[c]) for value in found]
            assert actual == pytest.approx(list((wanted or NOTHING).values()), rel=1e-9, abs=1e-9, nan_ok=True)
        assert all(flag == expected[2] for flag in contradicted[c])


@given(st.randoms(use_true_random=False), st.integers(0, 1000))
def test_the_order_of_the_entries_does_not_matter(random, seed):
    rng = np.random.default_rng(seed)
    cell = [entry(**draw_height(rng, [0.0, 0.3])) for _ in range(6)]
    shuffled = random.sample(cell, len(cell))
    first = [draw_height(rng, [0.0, 0.3])]
    a, b = run(first, [None], [cell]), run(first, [None], [shuffled])
    torch.testing.assert_close(torch.stack([*a.first, *a.other]), torch.stack([*b.first, *b.other]), equal_nan=True)


def test_agreeing_heights_are_averaged_by_their_variances():
    fused = run([dict(h=0.0, v=1e-4, t=10.0)], [None], [[entry(0.01, v=1e-4), entry(0.02, v=2e-4)]])
    assert float(fused.first.variance) == pytest.approx(1 / (1e4 + 1e4 + 5e3))
    assert float(fused.first.elevation) == pytest.approx((0.01 * 1e4 + 0.02 * 5e3) / 2.5e4)
    assert not fused.is_contradicted.any()


def test_a_false_step_is_not_averaged():
    fused = run([dict(h=0.0, v=1e-4, t=10.0)], [None], [[entry(0.5, v=1e-4, t=11.0)]])
    assert float(fused.first.elevation) == 0.5 and float(fused.other.elevation) == 0.0
    assert fused.is_contradicted.all()


def test_of_two_heights_of_one_time_the_one_merged_later_wins():
    fused = run([dict(h=0.0, v=1e-4, t=10.0)], [None], [[entry(0.5, v=1e-4, t=10.0)]])
    assert float(fused.first.elevation) == 0.5


def test_what_contradicted_the_elevation_long_ago_does_not_keep_a_newer_height_out():
    long_ago = dict(h=-0.5, v=1e-6, t=1.0)
    fused = run([dict(h=0.0, v=1e-4, t=10.0)], [long_ago], [[entry(0.5, v=1e-4, t=11.0)]])
    assert float(fused.first.elevation) == 0.5 and float(fused.other.elevation) == 0.0


@pytest.mark.parametrize("apart, is_step", [(0.05, False), (0.065, True)])
def test_two_heights_contradict_each_other_beyond_the_gate_of_their_difference(apart, is_step):
    fused = run([dict(h=0.0, v=1e-4, t=10.0)], [None], [[entry(apart, v=1e-4)]])  # 4 sigma are 5.7 cm
    assert bool(fused.is_contradicted) == is_step and bool(fused.other.known) == is_step


def test_a_much_less_certain_newer_height_does_not_replace_the_elevation():
    fused = run([dict(h=0.0, v=1e-6, t=10.0)], [None], [[entry(0.5, v=1e-4, t=11.0)]])
    assert float(fused.first.elevation) == 0.0 and float(fused.other.elevation) == 0.5


def test_age_lets_the_newer_height_win():
    first = [dict(h=0.0, v=1e-6, t=0.0)]
    assert float(run(first, [None], [[entry(0.5, v=1e-4, t=1000.0)]], rate=1e-7).first.elevation) == 0.5


def test_an_earlier_contribution_counts_once():
    contributed = dict(h=0.1, v=1e-4, t=5.0)
    again = run([contributed], [None], [[entry(0.1, v=1e-4, t=5.0, contributed=contributed)]])
    assert float(again.first.variance) == pytest.approx(1e-4)
    better = run([contributed], [None], [[entry(0.11, v=2.5e-5, t=6.0, contributed=contributed)]], rate=0.0)
    assert float(better.first.elevation) == pytest.approx(0.11) and float(better.first.variance) == pytest.approx(
        2.5e-5
    )


def test_what_contradicts_the_elevation_counts_once_too():
    site, other = dict(h=0.0, v=1e-6, t=5.0), dict(h=0.5, v=1e-4, t=5.0)
    fused = run([site], [other], [[entry(0.5, v=9e-5, t=5.0, contributed=other)]], rate=0.0)
    assert float(fused.other.variance) == pytest.approx(9e-5) and float(fused.first.variance) == pytest.approx(1e-6)


def test_contributions_of_others_stay():
    contributed = dict(h=0.1, v=2e-4, t=5.0)
    site = dict(h=0.1, v=1e-4, t=5.0)  # half of it from another robot
    fused = run([site], [None], [[entry(0.1, v=1e-4, t=5.0, contributed=contributed)]], rate=0.0)
    assert float(fused.first.variance) == pytest.approx(1 / (5e3 + 1e4))


def test_cells_without_entries_keep_every_bit():
    first = [dict(h=0.123456789, v=1.7e-5, t=3.3), dict(h=0.2, v=1e-4, t=1.0)]
    fused = run(first, [None, None], [[], [entry(0.2)]])
    assert [float(value[0]) for value in fused.first] == list(first[0].values())
