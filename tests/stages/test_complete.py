"""Predictions as cells of the map: they give way to measurements, and are not completed from."""

import copy

import pytest
import torch

from tests.helpers import differences, scan, small_map, snapshot, with_completion
from tests.site.helpers import known_cells
from torchelev import CompletionConfig
from torchelev.io.map_file import load_map, save_map
from torchelev.site import SiteMap
from torchelev.stages.complete import complete_map, forget_completed, write_back
from torchelev.state import tally

EVERYWHERE = dict(write_back=True, max_std=1e3)


def pair(num_envs=2, **settings):
    """A map with completion, and one that also writes it back."""
    settings = EVERYWHERE | settings
    return small_map(num_envs, **with_completion()), small_map(num_envs, **with_completion(**settings))


def look(emap, seed, shift=(0.0, 0.0), num_points=60):
    cloud, T = scan(seed, emap.num_envs, num_points)
    base = T.clone()
    base[:, :2, 3] += torch.tensor(shift, dtype=T.dtype)
    emap.update(cloud, T, base, 0.3)
    return emap


def still(seed):
    """A scan after which the window stays."""
    cloud, T = scan(seed, 2, 60)
    return cloud, T, None


def predicted(emap):
    return emap.validity & (emap.state.support < 0)


def test_unknown_cells_take_the_prediction():
    plain, emap = (look(m, 0) for m in pair())
    open_cells = ~plain.validity
    assert torch.equal(predicted(emap), open_cells) and open_cells.any() and emap.validity.all()
    assert torch.equal(emap.layer("elevation")[open_cells], plain.layer("completed")[open_cells])
    std = plain.layer("completed_std")[open_cells]
    torch.testing.assert_close(emap.layer("variance")[open_cells], std.square())
    assert (emap.layer("time")[open_cells] == 0).all() and emap.layer("traversability")[open_cells].isnan().all()


def test_only_sure_predictions_are_written():
    plain, emap = (look(m, 0) for m in pair())
    limit = float(plain.layer("completed_std")[~plain.validity].median())
    strict = look(pair(max_std=limit)[1], 0)
    assert torch.equal(predicted(strict), ~plain.validity & (plain.layer("completed_std") < limit))
    assert 0 < predicted(strict).sum() < predicted(emap).sum()


@pytest.mark.parametrize("chunk", [None, 1])
@pytest.mark.parametrize("shift", [(0.0, 0.0), (0.1, -0.2)])
def test_measured_cells_are_those_of_a_map_without(shift, chunk):
    """So the first measurement of a predicted cell gives its elevation and variance alone."""
    plain, emap = pair()
    emap.chunk = chunk
    taken = 0
    for seed in range(4):
        before = predicted(emap).clone()
        for m in (plain, emap):
            look(m, seed, (shift[0] * seed, shift[1] * seed))
        taken += int((before & ~predicted(emap)).sum())
        measured = emap.measured_state
        assert torch.equal(measured.validity, plain.validity)
        for name in ("elevation", "variance", "support", "time"):
            ours, theirs = (getattr(s, name)[plain.validity] for s in (measured, plain.state))
            torch.testing.assert_close(ours, theirs, atol=1e-6, rtol=1e-6)
        for name in ("bounded", "has_normal", "rated", "gradient_x", "traversability"):
            torch.testing.assert_close(getattr(measured, name), getattr(plain.state, name))
        for name in ("completed", "completed_std"):
            torch.testing.assert_close(emap.layer(name), plain.layer(name))
    assert taken > 20


def test_of_two_predictions_the_surer_stays():
    _, emap = pair()
    emap.update(*still(0), dt=0.3)
    first, before = predicted(emap).clone(), snapshot(emap)
    emap.update(*still(1), dt=0.3)
    both = first & predicted(emap)
    new = complete_map(emap.state, emap.cfg.grid, emap.completion_net.weights)
    expected = torch.minimum(before.variance, new.std.square())[both]
    torch.testing.assert_close(emap.state.variance[both], expected)
    stays = both & (before.variance < new.std.square())
    drift = emap.statistics.drift_correction[:, None, None].expand_as(stays)
    torch.testing.assert_close(emap.elevation[stays], (before.elevation + drift)[stays])
    renewed = both & ~stays
    torch.testing.assert_close(emap.elevation[renewed], new.mean[renewed])
    assert stays.any() and renewed.any()


def test_a_prediction_above_the_bound_is_given_up():
    _, emap = pair()
    look(emap, 0)
    before = snapshot(emap)
    cell = predicted(emap) & emap.state.bounded
    sure = before._replace(variance=torch.where(cell, 0.0, before.variance), elevation=before.elevation + 5 * cell)
    state = write_back(sure, forget_completed(before), emap.cfg.grid, emap.completion_net.weights, 1e3)
    assert cell.any() and torch.equal(state.elevation, before.elevation)


def test_it_moves_with_the_window_and_its_drift():
    _, emap = pair(1)
    look(emap, 0)
    before = snapshot(emap)
    sure = before._replace(variance=torch.where(predicted(emap), 0.0, before.variance), bounded=before.bounded & False)
    moved = forget_completed(sure)._replace(
        corner=before.corner + torch.tensor([2, -1]), validity=before.validity & False
    )
    moved = tally(moved, drift_correction=torch.tensor([0.2]))
    state = write_back(sure, moved, emap.cfg.grid, emap.completion_net.weights, 1e3)
    ours, theirs = state.validity[0, :-2, 1:], predicted(emap)[0, 2:, :-1]
    assert torch.equal(ours, theirs) and ours.any() and not state.validity[0, -2:].any()
    expected = before.elevation[0, 2:, :-1][theirs] + 0.2
    torch.testing.assert_close(state.elevation[0, :-2, 1:][theirs], expected)


def test_forward_is_update():
    _, emap = pair()
    look(emap, 0)
    cloud, T = scan(1, 2, 60)
    state = emap(emap.state, emap.measure(cloud, T, T, 0.3))
    before = snapshot(emap)
    emap.update(cloud, T, T, 0.3)
    assert "elevation" in differences(before, emap.state)
    for name in ("elevation", "variance", "support", "validity", "time"):
        torch.testing.assert_close(getattr(state, name), getattr(emap.state, name))


def test_what_starts_or_merges_maps_leaves_predictions_out(tmp_path):
    plain, emap = (look(m, 0) for m in pair())
    sites = SiteMap(0.1), SiteMap(0.1)
    for site, m in zip(sites, (plain, emap), strict=True):
        site.merge(m)
    assert known_cells(sites[1]) == known_cells(sites[0])
    save_map(tmp_path / "map.npz", emap)
    assert differences(load_map(tmp_path / "map.npz").state, emap.state) == []
    assert differences(copy.deepcopy(emap).state, emap.state) == []
    feet = torch.zeros(2, 4, 3)
    for m in (plain, emap):
        m.initialize(feet, "nearest")
    assert differences(plain.state, emap.state, skip=("elevation", "variance", "support", "time")) == []
    torch.testing.assert_close(emap.elevation, plain.elevation)
    emap.reset()
    assert not emap.validity.any() and emap.layer("completed").isnan().all()


def test_an_environment_that_knows_nothing_gets_no_predictions():
    _, emap = pair()
    cloud, T = scan(0, 2, 60)
    cloud[1] = torch.nan
    emap.update(cloud, T, T, 0.1)
    assert emap.validity[0].all() and not emap.validity[1].any()


def test_refuses():
    with pytest.raises(TypeError, match="completion.write_back: must be a bool, got 1"):
        CompletionConfig(write_back=1)
    with pytest.raises(ValueError, match="completion.max_std: must be a positive number"):
        CompletionConfig(max_std=0.0)
