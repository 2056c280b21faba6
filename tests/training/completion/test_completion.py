"""The training of the completion network: its data, its losses, and its commands."""

import functools
import json
import math

import numpy as np
import pytest
import torch
from click.testing import CliRunner

import training.completion.evaluate as evaluation
import training.completion.train as training
from torchelev.completion.complete import CompletionInput
from training.completion.cells import draw_evenly, draw_measured, draw_unknown, remove_cells, thin_out, vary_bounds
from training.completion.maps import TrueMap, WalkConfig, Walks, drive, walk
from training.completion.trainer import COVERAGE, FitConfig, Trainer, fit_std, losses
from training.completion.unet import UNet, fit
from training.completion.yards import LENGTH, draw_way, make_yard
from training.resume import CHECKPOINT

TINY = functools.partial(WalkConfig, num_maps=1, window=1.6, scans=(1, 2))
TINY_YARD = WalkConfig(num_maps=1, window=6.0, scans=(2, 3))


def invoke(main, *arguments, obj):
    return CliRunner().invoke(main, [*map(str, arguments)], obj=obj, catch_exceptions=False)


@functools.cache
def tiny_walk():
    return walk((0, 0, 1), ("stairs_down",), 0.08, TINY())


def flat_map(num_envs=1, size=12, rise=0.1):
    """A level map whose right half is unknown; the ground there is `rise` [m] higher."""
    zero = torch.zeros(num_envs, size, size)
    known = zero == 1
    known[:, :, : size // 2] = True
    truth = torch.where(known, 0.0, rise)
    layers = CompletionInput(zero, known, zero + 1e-4, zero + 0.5, ~known, zero)
    return TrueMap(layers, truth, torch.ones_like(known), 0.08, ("slope",) * num_envs, 1)


@pytest.mark.slow(3)
def test_walks_repeat_and_the_map_is_near_the_truth_where_measured():
    first, again = tiny_walk()[-1], walk((0, 0, 1), ("stairs_down",), 0.08, TINY())[-1]
    assert torch.equal(first.layers.elevation, again.layers.elevation)
    assert [entry.scans for entry in tiny_walk()] == [1, 2]
    measured = first.layers.validity & first.is_inside
    assert int(measured.sum()) > 50
    assert float((first.layers.elevation - first.truth)[measured].abs().median()) < 0.05


def test_cells_come_with_their_truth_and_maps_count_the_same():
    maps, generator = flat_map(2), torch.Generator().manual_seed(0)
    maps.truth[1, :, 6:] = 1.0  # a deeper hole, in which errors weigh less
    for cells, truth in zip(draw_unknown(maps, generator), (0.1, 1.0), strict=True):
        assert float(cells.truth.min()) == float(cells.truth.max()) == pytest.approx(truth)
        assert float(cells.weight[0] * (truth + 0.005)) == pytest.approx(1.0)
    measured = draw_measured(maps, generator)[0]
    assert float(measured.seen.height.abs().max()) == float(measured.truth.abs().max()) == 0.0
    assert float(measured.seen.sigma.min()) == float(measured.seen.sigma.max()) == pytest.approx(0.01)
    assert measured.context.known[1].unique().tolist() == pytest.approx([6 * 12 / 31**2]), "of 1.2 m to all sides"


@pytest.mark.slow(4)
def test_drives_leave_their_way_free_and_map_the_yard_near_the_truth():
    rng = np.random.default_rng(3)
    way = draw_way(4, rng)
    heights = make_yard(way, 4, rng)
    axis = torch.linspace(-LENGTH / 2, LENGTH / 2, len(heights), dtype=torch.float64)
    x, y = torch.meshgrid(axis, axis, indexing="ij")
    is_way = way.distance(x, y, 4) < 0.5
    steps = heights.diff(dim=0).abs()[is_way[1:]]
    assert float(steps.max()) < 0.5 < float(heights.diff(dim=0).abs().max()), "things are steep, the way is not"
    places = torch.from_numpy(way.places(4))
    assert float(way.distance(places[:, 0], places[:, 1], 4).max()) < 1e-9
    maps = drive((3, 0, 0), 0.1, TINY_YARD)[-1]
    known = maps.layers.validity & maps.is_inside
    assert int(known.sum()) > 100 and float((maps.layers.elevation - maps.truth)[known].abs().median()) < 0.1


def test_removed_cells_are_neither_known_nor_bounded():
    layers = flat_map().layers
    layers = layers._replace(bounded=torch.ones_like(layers.bounded))
    kept = torch.zeros_like(layers.validity)
    kept[:, :3] = True
    removed = remove_cells(layers, kept)
    assert torch.equal(removed.validity, layers.validity & kept)
    assert torch.equal(removed.bounded, ~(layers.validity & ~kept))


def test_thinned_maps_bound_what_they_lost_and_bounds_stay_true():
    layers, generator = flat_map(8, 20).layers, torch.Generator().manual_seed(0)
    thinned = thin_out(layers, generator)
    lost = layers.validity & ~thinned.validity
    shares = thinned.validity.float().mean((1, 2)) / layers.validity.float().mean((1, 2))
    assert 0.02 < float(shares.min()) < float(shares.max()) < 0.7
    assert bool(thinned.bounded[lost].all()) and torch.equal(thinned.upper_bound[lost], layers.elevation[lost])
    varied = vary_bounds(layers, generator)
    kept = varied.bounded.flatten(1).any(1)
    rise = (varied.upper_bound - layers.upper_bound).flatten(1)[:, 0]
    assert 0 < int(kept.sum()) < 8 and float(rise.min()) == 0.0 < float(rise.max()) <= 3.0


def test_the_standard_deviation_is_fitted_to_hold_the_coverage():
    """Of the errors of any distribution, half the COVERAGE quantile has the least loss; the mean gets no gradient."""
    error = torch.randn(20_000, generator=torch.Generator().manual_seed(0)) ** 3
    stds = torch.linspace(0.2, 6.0, 200)
    loss = torch.stack([losses(error, std.expand_as(error), torch.ones_like(error))[1] for std in stds])
    best = float(stds[loss.argmin()])
    assert best == pytest.approx(float(error.abs().quantile(COVERAGE)) / 2, abs=0.06)
    assert float(fit_std(error, torch.full_like(error, best))) == pytest.approx(1.0, abs=0.03)
    free = error.clone().requires_grad_(True)
    losses(free, torch.ones_like(free, requires_grad=True), torch.ones_like(free))[1].backward()
    assert free.grad is None


def test_cells_to_calibrate_with_are_drawn_evenly():
    maps, generator = flat_map(40, 60), torch.Generator().manual_seed(0)
    cells = draw_evenly(maps, generator)[0]
    unknown = int((~maps.layers.validity).sum())
    assert len(cells.truth) == pytest.approx(0.01 * unknown, rel=0.15)
    assert bool((cells.truth == 0.1).all()) and bool((cells.weight == 1).all())
    steps = cells.seen.around.distance[cells.seen.around.is_known > 0].view(-1)
    assert float(steps.min()) == pytest.approx(0.08) and float(steps.max()) > 1.5, "near and far ones"


@pytest.mark.slow(2)
def test_a_network_learns_a_step(tmp_path):
    """All unknown ground is 1.5 cm higher: after some steps, the network says so, and how sure that is."""
    maps, generator = flat_map(rise=0.015), torch.Generator().manual_seed(0)
    unknown = draw_unknown(maps, generator)[0]
    cells = unknown, draw_measured(maps, generator)[0], unknown
    trainer = Trainer(*cells, FitConfig(steps=150, unknown_per_step=128, measured_per_step=32))
    trainer.run(tmp_path)
    with torch.no_grad():
        mean, std = trainer.net(*maps.layers, resolution=0.08)
    unknown = ~maps.layers.validity
    assert float((mean - 0.015)[unknown].abs().mean()) < 0.003
    assert float(((mean - maps.truth).abs() <= 2 * std)[unknown].float().mean()) > 0.9


def test_a_training_resumes_without_a_difference(tmp_path):
    maps, generator = flat_map(), torch.Generator().manual_seed(0)
    unknown = draw_unknown(maps, generator)[0]
    cells = unknown, draw_measured(maps, generator)[0], unknown
    cfg = FitConfig(steps=6, unknown_per_step=32, measured_per_step=8)
    whole, first, second = (Trainer(*cells, cfg) for _ in range(3))
    for trainer, steps in ((whole, 6), (first, 3)):
        for _ in range(steps):
            trainer.advance()
    first.save(tmp_path / CHECKPOINT)
    second.resume(tmp_path / CHECKPOINT)
    for _ in range(3):
        second.advance()
    for a, b in zip(whole.net.parameters(), second.net.parameters(), strict=True):
        assert torch.equal(a, b)
    with pytest.raises(ValueError, match="must be of the same settings, got steps 6"):
        Trainer(*cells, FitConfig(steps=7, unknown_per_step=32, measured_per_step=8)).resume(tmp_path / CHECKPOINT)


def test_the_u_net_stays_below_the_bound_and_learns():
    maps = flat_map()
    low = maps._replace(layers=maps.layers._replace(upper_bound=maps.layers.upper_bound - 0.45))
    net = fit([low], 2, 20)
    with torch.no_grad():
        filled = net(low)
        untrained = UNet(2)(low)
    unknown = ~low.layers.validity
    assert float(filled[unknown].max()) <= 0.05 + 1e-6
    assert float((filled - low.truth)[unknown].abs().mean()) <= float((untrained - low.truth)[unknown].abs().mean())


@pytest.mark.slow(6)
def test_the_commands_train_evaluate_and_resume(tmp_path):
    tiny = {name: TINY_YARD if "yards" in name else TINY() for name in evaluation.SPLITS}
    splits = {name: evaluation.Split(cfg, (0.08,)) for name, cfg in tiny.items()}
    ground = training.Ground(TINY(), TINY_YARD, splits)
    out = tmp_path / "run"
    drawn = ("--walks", 2, "--drives", 1, "--collages", 1, "--evaluation-walks", 1)
    common = ("--out", out, *drawn, "--jobs", 1, "--steps", 2)
    done = invoke(training.main, *common, obj=ground)
    assert done.exit_code == 0 and "| held_out | 0.08 | unknown |" in done.output
    result = json.loads((out / "result.json").read_text(), parse_constant=pytest.fail)
    cells = result["held_out"]["0.08"]["CompletionNet"]["unknown"]
    assert result["held_out_yards"]["0.08"]["CompletionNet"]["unknown"]["cells"] > 10
    assert cells["cells"] > 10 and math.isfinite(cells["mae"]) and 0 <= cells["within_2_std"] <= 1
    assert "add --resume" in invoke(training.main, *common, obj=ground).output
    assert invoke(training.main, *common, "--resume", obj=ground).exit_code == 0, "nothing left: it only evaluates"
    other = invoke(training.main, *common[:-1], 3, "--resume", obj=ground)
    assert other.exit_code == 2 and "must be of the same settings, got steps 2" in other.output
    options = ("--data", out / "data", "--walks", 1, "--jobs", 1, "--out", tmp_path / "evaluation.json")
    again = invoke(evaluation.main, "--weights", out / "weights.pt", *options, obj=splits)
    assert again.exit_code == 0
    found = json.loads((tmp_path / "evaluation.json").read_text())
    assert found["held_out"]["0.08"]["CompletionNet"] == result["held_out"]["0.08"]["CompletionNet"]


@pytest.mark.slow(3)
def test_walks_of_other_settings_are_refused(tmp_path):
    walks = Walks(tmp_path, "unseen", 0, TINY(scans=(1,)), 0.08)
    walks.make(0)
    assert walks.read(0)[0].kinds == ("stepping_stones",)
    other = walks._replace(cfg=TINY(scans=(1, 2)))
    with pytest.raises(ValueError, match="must be of the same settings, got other scans"):
        other.read(0)
    with pytest.raises(ValueError, match="scans: must be positive and ascend"):
        WalkConfig(scans=(3, 1))
