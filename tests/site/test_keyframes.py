"""Moving keyframes: the site becomes what mapping with the corrected poses from the start gives."""

import os

import numpy as np
import pytest
import torch

from tests.helpers import pose, rotation, small_map
from tests.processes import run_python
from tests.site.helpers import fill, ground, known_cells, live, robots
from torchelev.site import SiteMap
from torchelev.site.keyframes import rebuild

LAYERS = ("elevation", "variance", "time", "upper_bound", "other_elevation", "other_variance")
STARTS = np.array([(0, 0), (25, 10), (-30, 20)])  # [cells] corners of three robots' windows that overlap
STEP = np.array([14, 3])  # [cells] that each of them goes on from merge to merge
CELLS, NUM_MERGES = (40, 36), 4


def at(corners, heights=0.5):
    """Poses in the middle of windows."""
    T = pose(num_envs=len(corners))
    T[:, :2, 3] = (torch.as_tensor(corners) + torch.tensor(CELLS) / 2) * 0.1
    T[:, 2, 3] = torch.as_tensor(heights).expand(len(corners))
    return T


def drive(site, cell_shifts=None, rises=None, heights=ground, merges=NUM_MERGES, emap=None, first=0, **options):
    """Merge three robots several times; each merge's windows lie off by whole cells and by heights.

    What the robots believe of a cell they take along: what they see is that of the cells without the shifts.
    """
    emap = small_map(3, CELLS) if emap is None else emap
    for k in range(first, first + merges):
        corners = STARTS + k * STEP
        shift = np.zeros((3, 2), int) if cell_shifts is None else cell_shifts[k]
        rise = torch.zeros(3) if rises is None else rises[k]
        fill(emap, corners, heights, offsets=rise, noise=0.002, known=0.9, seed=k)
        state = emap.state
        state.bounded.copy_(~state.validity & (state.elevation == 0))
        state.upper_bound.copy_(rise[:, None, None] + 0.7 + 0.1 * k)
        if k == 2:
            state.elevation[1, 5:15, 20:30] += 0.4  # contradicts the others
        emap.corner.copy_(torch.from_numpy(corners + shift))
        site.merge(emap, T_map_base=at(corners + shift, 0.5 + rise), align=False, **options)
        live(emap, 1.0)
    return emap


def assert_same(a, b, tolerance=1e-4):
    for layer in LAYERS:
        first, second = known_cells(a, layer), known_cells(b, layer)
        assert first.keys() == second.keys(), layer
        np.testing.assert_allclose([first[c] for c in first], [second[c] for c in first], atol=tolerance, err_msg=layer)


def every_bit(site):
    return {tile: site._tiles.read([tile]).numpy().tobytes() for tile in site._tiles}


@pytest.fixture(params=["memory", "disk"])
def site(request, tmp_path):
    with SiteMap(0.1, None if request.param == "memory" else tmp_path / "site", keyframes=True) as made:
        yield made


@pytest.mark.slow(1)
def test_keeping_keyframes_changes_nothing(site):
    plain = SiteMap(0.1)
    drive(site), drive(plain)
    for layer in LAYERS:
        assert known_cells(site, layer) == known_cells(plain, layer)
    assert len(known_cells(site, "other_elevation")) > 20 and len(known_cells(site, "upper_bound")) > 1000


@pytest.mark.slow(1)
def test_corrections_along_z_and_by_whole_cells_are_those_of_mapping_from_the_start(site):
    rng = np.random.default_rng(0)
    shifts = rng.integers(-9, 9, (NUM_MERGES, 3, 2))
    rises = torch.from_numpy(rng.uniform(-0.2, 0.2, (NUM_MERGES, 3))).float()
    drive(site, shifts, rises)
    truth = SiteMap(0.1)
    drive(truth)
    moved = torch.cat([at(STARTS + k * STEP) for k in range(NUM_MERGES)])
    site.move_keyframes(site.keyframes.ids, moved)
    assert_same(site, truth)
    torch.testing.assert_close(site.keyframes.T_map_base, moved)


@pytest.mark.slow(1)
def test_moving_there_and_back_changes_no_bit(site):
    drive(site)
    before, poses = every_bit(site), site.keyframes.T_map_base
    turn = torch.from_numpy(rotation(0.2, 0.01, -0.02))
    away = poses.clone()
    away[:, :3, :3], away[:, :3, 3] = turn @ poses[:, :3, :3], poses[:, :3, 3] + torch.tensor([3.1, -1.0, 0.2])
    site.move_keyframes(torch.arange(12), away)
    assert every_bit(site) != before
    site.move_keyframes(torch.arange(12), poses)
    after = every_bit(site)
    assert {tile: after[tile] for tile in before} == before


def test_other_tiles_keep_every_bit(site):
    drive(site)
    emap = robots([(640, 0)])
    site.merge(emap, T_map_base=at([(640, 0)]), align=False)
    assert site.keyframes.robots.tolist() == 4 * [0, 1, 2] + [3]
    written, write = [], site._tiles.write
    before = every_bit(site)
    site._tiles.write = lambda tiles, values: (written.extend(tiles), write(tiles, values))
    site.move_keyframes(torch.tensor([12]), at([(640, 0)], 0.7))
    assert written and all(a >= 10 for a, _ in written)
    after = every_bit(site)
    assert all(before[tile] == after[tile] for tile in before if tile[0] < 10)
    assert known_cells(site)[(650, 10)] == pytest.approx(known_cells_of(emap)[(650, 10)] + 0.2, abs=1e-6)


def known_cells_of(emap):
    x, y = emap.corner[0].tolist()
    return {(x + i, y + j): float(emap.elevation[0, i, j]) for i in range(40) for j in range(36)}


def test_the_offset_that_was_subtracted_is_part_of_the_pose(site):
    site.merge(robots([(0, 0)]), T_map_base=at([(0, 0)]))
    site.merge(robots([(5, 5)], offsets=[0.25]), T_map_base=at([(5, 5)], 0.75))
    torch.testing.assert_close(site.keyframes.T_map_base[:, 2, 3], torch.tensor([0.5, 0.5]).double(), atol=2e-3, rtol=0)
    before = known_cells(site)
    site.move_keyframes(torch.tensor([0, 1]), at([(0, 0), (5, 5)], torch.tensor([0.6, 0.6])))
    after = known_cells(site)
    assert all(after[cell] == pytest.approx(before[cell] + 0.1, abs=2e-3) for cell in before)


def test_a_tilt_that_was_subtracted_is_part_of_the_pose(site):
    site.merge(robots([(0, 0)], heights=lambda x, y: 0 * x), T_map_base=at([(0, 0)]))
    tilted = robots([(0, 0)], heights=lambda x, y: 0.05 * (x - 2) - 0.02 * (y - 1.8))
    turn = torch.from_numpy(rotation(0.0, -0.05, -0.02))
    T = at([(0, 0)])
    T[0, :3, :3] = turn
    site.merge(tilted, T_map_base=T, tilt=True)
    torch.testing.assert_close(site.keyframes.T_map_base[1, :3, :3], torch.eye(3).double(), atol=3e-3, rtol=0)


@pytest.mark.parametrize("turn", [(0.0, 0.0, 0.0), (0.3, 0.0, 0.0), (-0.1, 0.03, -0.02), (np.pi / 2, 0.0, 0.0)])
def test_any_correction_is_right_within_half_a_cell(site, turn):
    """The robot sees the ground from elsewhere than it believes: p_true = R (p - c) + c + shift."""
    R, shift = torch.from_numpy(rotation(*turn)), torch.tensor([1.234, -0.777, 0.3]).double()
    center = at([(20, -40)])[0, :3, 3]

    def slope(x, y):
        return 0.2 * x - 0.1 * y

    normal = R.T @ torch.tensor([-0.2, 0.1, 1.0]).double()  # of the same ground where the robot believes it
    constant = slope(*(center + shift)[:2]) - (center + shift)[2]

    def seen(x, y):
        return center[2] + (constant - normal[0] * (x - center[0]) - normal[1] * (y - center[1])) / normal[2]

    site.merge(robots([(20, -40)], heights=seen), T_map_base=at([(20, -40)]), align=False)
    T = at([(20, -40)])
    T[0, :3, :3], T[0, :3, 3] = R, center + shift
    site.move_keyframes(torch.tensor([0]), T)
    cells = known_cells(site)
    assert len(cells) == pytest.approx(40 * 36, rel=0.05)
    x, y = (torch.tensor(list(cells)).double().T + 0.5) * 0.1
    error = torch.tensor(list(cells.values())).double() - slope(x, y)
    steepness = 0.05 * ((normal[0].abs() + normal[1].abs()) / normal[2] + 0.02)
    assert error.abs().max() <= steepness + 1e-4
    if turn[0] not in (0.0, np.pi / 2):  # else all cells lie off by the same part of a cell
        assert error.mean().abs() < 0.2 * steepness
    far = (torch.stack([x, y], 1) - (center + shift)[:2]).abs().amax()
    assert far < 0.1 * np.hypot(20, 18) + 0.1


@pytest.mark.slow(1)
def test_mapping_goes_on_after_a_correction(site):
    rng = np.random.default_rng(1)
    shifts = rng.integers(-5, 5, (NUM_MERGES, 3, 2))
    shifts[2:] = 0
    emap = drive(site, shifts, merges=2)
    site.move_keyframes(torch.arange(6), torch.cat([at(STARTS + k * STEP) for k in range(2)]))
    drive(site, shifts, merges=2, emap=emap, first=2)
    truth = SiteMap(0.1)
    drive(truth)
    assert_same(site, truth)


@pytest.mark.slow(1)
def test_opening_again_continues(tmp_path):
    rises = torch.tensor([[0.1, 0.0, -0.1]]).expand(NUM_MERGES, 3)
    with SiteMap(0.1, tmp_path, keyframes=True) as site:
        emap = drive(site, rises=rises, merges=2)
        site.move_keyframes([0, 1], at(STARTS[:2]))
    with SiteMap(0.1, tmp_path) as site:
        torch.testing.assert_close(site.keyframes.T_map_base[:3, 2, 3], torch.tensor([0.5, 0.5, 0.4]).double())
        drive(site, rises=rises, merges=2, emap=emap, first=2)
        assert site.keyframes.robots.tolist() == 4 * [0, 1, 2]
        assert site.keyframes.times.tolist() == [k for k in range(4) for _ in range(3)]
    with SiteMap.open(tmp_path) as site:
        site.move_keyframes(torch.arange(2, 12), torch.cat([at(STARTS + k * STEP) for k in range(4)])[2:])
        truth = SiteMap(0.1)
        drive(truth)
        assert_same(site, truth)


@pytest.mark.slow(1)
def test_a_move_that_fails_changes_nothing(site, monkeypatch):
    drive(site)
    before, poses = every_bit(site), site.keyframes.T_map_base
    moved = poses.clone()
    moved[:, 2, 3] += 0.5
    calls = []

    def fail(*args):
        calls.append(1)
        if len(calls) > 3:
            raise KeyboardInterrupt
        return original(*args)

    original = rebuild.fuse_entries
    monkeypatch.setattr(rebuild, "fuse_entries", fail)
    with pytest.raises(KeyboardInterrupt):
        site.move_keyframes(torch.arange(12), moved)
    monkeypatch.undo()
    assert every_bit(site) == before and torch.equal(site.keyframes.T_map_base, poses)
    site.move_keyframes(torch.arange(12), moved)
    assert known_cells(site) != before


KILLED = """
import os, signal, torch
from torchelev.site import SiteMap
from torchelev.site.keyframes import rebuild
fuse, calls = rebuild.fuse_entries, []
def die(*args):
    calls.append(1)
    if len(calls) == 6:
        os.kill(os.getpid(), signal.SIGKILL)
    return fuse(*args)
rebuild.fuse_entries = die
site = SiteMap.open({path!r})
T = site.keyframes.T_map_base
T[:, 2, 3] += 1.0
site.move_keyframes(torch.arange(12), T)
"""


@pytest.mark.slow(3)
@pytest.mark.skipif(os.name == "nt", reason="no SIGKILL")
def test_a_killed_move_changes_nothing(tmp_path):
    with SiteMap(0.1, tmp_path, keyframes=True) as site:
        drive(site)
        before, poses = every_bit(site), site.keyframes.T_map_base
    assert run_python(KILLED.format(path=str(tmp_path))).returncode == -9
    with SiteMap(0.1, tmp_path) as site:
        assert every_bit(site) == before and torch.equal(site.keyframes.T_map_base, poses)


def test_a_keyframe_without_news_moves_what_later_ones_replace():
    """The second merge contributes nothing new, but the third replaces what the robot knew then: its pose counts."""

    def run(rise):
        site, emap = SiteMap(0.1, keyframes=True), robots([(0, 0)], std=0.01)
        site.merge(emap, T_map_base=at([(0, 0)]), align=False)
        live(emap, 1.0)
        emap.state.elevation.add_(rise)
        site.merge(emap, T_map_base=at([(0, 0)], 0.5 + rise), align=False)
        emap.state.elapsed.add_(10**9)
        fill(emap, [(0, 0)], std=0.008)
        site.merge(emap, T_map_base=at([(0, 0)]), align=False)
        return site

    site, truth = run(0.02), run(0.0)
    with pytest.raises(AssertionError):
        assert_same(site, truth)
    site.move_keyframes([1], at([(0, 0)]))
    assert_same(site, truth)


def test_a_robot_that_knows_nothing_leaves_an_empty_keyframe(site):
    emap = fill(small_map(2, CELLS), [(0, 0), (10, 0)])
    emap.state.validity[1] = False
    site.merge(emap, T_map_base=at([(0, 0), (10, 0)]))
    site.move_keyframes(torch.tensor([1]), at([(100, 0)]))
    site.move_keyframes(torch.tensor([0]), at([(0, 1)]))
    assert len(known_cells(site)) == 40 * 36


def test_bad_arguments_are_refused_by_name(tmp_path):
    plain, site = SiteMap(0.1), SiteMap(0.1, tmp_path / "a", keyframes=True)
    emap = robots([(0, 0)])
    with pytest.raises(ValueError, match="T_map_base: must be given, as keyframes are kept"):
        site.merge(emap)
    with pytest.raises(ValueError, match=r"T_map_base: expected \(1, 4, 4\)"):
        site.merge(emap, T_map_base=pose(num_envs=2))
    site.merge(emap, T_map_base=at([(0, 0)]))
    with pytest.raises(ValueError, match="keyframes: must be kept by the site"):
        _ = plain.keyframes
    with pytest.raises(ValueError, match="keyframes: must be kept by the site"):
        plain.move_keyframes([0], pose())
    with pytest.raises(ValueError, match=r"ids: must lie in \[0, 1\), got 1..1"):
        site.move_keyframes([1], pose())
    with pytest.raises(ValueError, match="ids: must not repeat"):
        site.move_keyframes([0, 0], pose(num_envs=2))
    with pytest.raises(ValueError, match="ids: must be 1-D int64"):
        site.move_keyframes([0.0], pose())
    with pytest.raises(ValueError, match=r"T_map_base: expected \(1, 4, 4\)"):
        site.move_keyframes([0], pose()[0])
    with pytest.raises(ValueError, match="T_map_base: must be rigid"):
        site.move_keyframes([0], 2 * pose())
    with pytest.raises(ValueError, match="site: must be open for writing"):
        SiteMap.open(tmp_path / "a", read_only=True).move_keyframes([0], pose())
    site.close()
    with SiteMap(0.1, tmp_path / "b") as begun:
        begun.merge(emap)
    with pytest.raises(ValueError, match="keyframes: must be kept from the first merge on"):
        SiteMap(0.1, tmp_path / "b", keyframes=True)


def test_a_robot_that_was_reset_and_given_the_corrected_site_does_not_spoil_it(site):
    emap = fill(small_map(1, CELLS), [(0, 0)])
    site.merge(emap, T_map_base=at([(0, 0)]))
    site.move_keyframes(site.keyframes.ids, at([(10, 0)]))
    emap.reset()
    emap.initialize_from(site, at([(10, 0)]))
    before = known_cells(site)
    emap.state.elapsed.add_(10**9)
    known = emap.state.validity
    emap.state.variance.copy_(torch.where(known, 0.5 * emap.state.variance, 1.0))  # measured again, at the same heights
    emap.state.elevation.add_(1e-5 * known)
    emap.state.time.zero_()
    site.merge(emap, T_map_base=at([(10, 0)]))
    after = known_cells(site)
    assert before.keys() == after.keys() and max(abs(after[c] - before[c]) for c in before) < 1e-4
