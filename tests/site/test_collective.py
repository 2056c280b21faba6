"""Sites that several processes share, against one process with all robots."""

import numpy as np
import pytest
import torch
import torch.distributed as dist

from tests.site import ranks
from tests.site.ranks import run_ranks
from torchelev.site import SiteMap
from torchelev.site.content.tiles import CELLS
from torchelev.site.shared.messages import make_messages, read_message
from torchelev.site.shared.owners import number_along_curve, share_out
from torchelev.site.shared.parts import cut_cells

SHARES = {
    2: [[0], list(range(1, 11))],
    4: [[0, 1, 2, 3, 4], [5], [6, 7], [8, 9, 10]],
    8: [[0], [1, 2], [3], [4], [5, 6, 7], [8], [9], [10]],
}


@pytest.fixture(scope="module")
def alone():
    """What one process with all robots finds."""
    return {tilt: ranks.mission(SiteMap(0.1), list(range(ranks.NUM_ROBOTS)), tilt) for tilt in (False, True)}


def results_of(values):
    """The results of all ranks, none of which may have raised."""
    errors = [value for value in values if isinstance(value, Exception)]
    assert not errors, errors
    return values


def assert_same(actual, expected):
    assert actual.keys() == expected.keys()
    for name, value in expected.items():
        np.testing.assert_allclose(actual[name], value, rtol=1e-6, atol=1e-6, err_msg=name)


@pytest.mark.slow(3)
@pytest.mark.parametrize(
    ("size", "on_disk", "tilt"),
    [(2, True, True), (2, False, False), (4, False, True), (4, True, False), (8, True, False)],
)
def test_ranks_hold_what_one_process_with_all_robots_holds(size, on_disk, tilt, alone, tmp_path):
    path = tmp_path / "site" if on_disk else None
    results = results_of(run_ranks(ranks.fly, size, tmp_path / "ranks", path, SHARES[size], tilt))
    reports, elevation, contents = alone[tilt]
    for step, expected in enumerate(reports):
        for k, value in enumerate(expected):
            found = np.concatenate([result[0][step][k] for result in results])
            np.testing.assert_allclose(found, value, rtol=0, atol=1e-6, err_msg=f"merge {step}, {k}")
    np.testing.assert_allclose(np.concatenate([result[1] for result in results]), elevation, atol=1e-6)
    for result in results:
        assert_same(result[2], contents)
    if on_disk:
        with SiteMap.open(path) as site:
            assert_same(ranks.contents(site), contents)


@pytest.mark.slow(1)
def test_on_disk_a_rank_keeps_its_own_tiles_in_memory(tmp_path):
    results = results_of(run_ranks(ranks.held, 2, tmp_path / "ranks", tmp_path / "site", SHARES[2]))
    for are_of_others, size, time in results:
        assert 0 < len(are_of_others) < size and not any(are_of_others)
        assert time == results[0][2]


def test_neighbours_along_the_curve_of_tiles_are_neighbours():
    x, y = (value.flatten() for value in torch.meshgrid(torch.arange(-16, 16), torch.arange(-16, 16), indexing="ij"))
    number = number_along_curve(x, y)
    assert len(number.unique()) == 32 * 32
    for quadrant in ((x < 0) & (y < 0), (x < 0) & (y >= 0), (x >= 0) & (y < 0), (x >= 0) & (y >= 0)):
        along, order = number[quadrant].sort()
        assert (along.diff() == 1).all()
        steps = [value[quadrant][order].diff().abs() for value in (x, y)]
        assert (steps[0] + steps[1] == 1).all()


@pytest.mark.parametrize("size", [2, 3, 4, 8])
def test_owners_share_the_windows(size):
    generator = torch.Generator().manual_seed(size)
    windows = [torch.randint(-40, 40, (480 // size, 2), generator=generator) for _ in range(size)]
    owners = share_out(windows)
    found = owners.find(*torch.cat(windows).unbind(1))
    assert torch.bincount(found, minlength=size).tolist() == pytest.approx([480 / size] * size, abs=4)
    assert sorted(owners.rank.tolist()) == list(range(size))


@pytest.mark.parametrize("axis", [0, 1])
@pytest.mark.parametrize("direction", [1, -1])
def test_ranks_own_the_tiles_below_their_robots(axis, direction):
    x, y = (value.flatten() for value in torch.meshgrid(torch.arange(16), torch.arange(16), indexing="ij"))
    order = (direction * torch.stack([x, y])[axis]).sort(stable=True).indices
    windows = [torch.stack([x, y], 1)[part] for part in order.split(128)]
    owners = share_out(windows)
    for rank, tiles in enumerate(windows):
        assert (owners.find(*tiles.unbind(1)) == rank).all()


def test_messages_are_read_as_they_were_written():
    tensors = [
        torch.arange(6).view(3, 2),
        torch.rand(3, 5),
        torch.arange(3, dtype=torch.int32),
        torch.zeros(0, 2, 2, 2),
    ]
    shapes = [(tensor.dtype, tuple(tensor.shape)) for tensor in tensors]
    memory, lengths, written = make_messages([shapes, [], shapes[:3]], torch.device("cpu"))
    for values in written:
        for value, tensor in zip(values, tensors, strict=False):
            value.copy_(tensor)
    found = [read_message(message) for message in memory.split(lengths)]
    assert [len(values) for values in found] == [4, 0, 3]
    assert all(torch.equal(a, b) for values in found for a, b in zip(values, tensors, strict=False))


@pytest.mark.parametrize("tiles", [[(0, 0), (0, 2), (0, 3), (5, 1)], [(0, 2), (0, 3), (5, 1)], [(0, 0), (5, 1)]])
def test_cells_get_the_numbers_of_a_group_of_tiles(tiles):
    group, numbered = torch.tensor([(0, 1), (0, 2), (0, 3), (0, 4)]), torch.tensor(tiles)
    cell = torch.tensor([CELLS * tile + k for tile in range(len(tiles)) for k in (0, 3, CELLS - 1)])
    found, part = cut_cells(numbered, cell.int(), group)
    named = [(*tiles[c // CELLS], c % CELLS) for c in cell.tolist()]
    assert [(*group[c // CELLS].tolist(), c % CELLS) for c in found.tolist()] == named[part]
    assert named[part] == [name for name in named if list(name[:2]) in group.tolist()]
    gap, _ = cut_cells(torch.tensor([(0, 1), (0, 3)]), torch.tensor([5, CELLS + 7]), group)
    assert gap.tolist() == [5, 2 * CELLS + 7]


@pytest.mark.slow(1)
@pytest.mark.parametrize("slow", ["reading", "writing"])
def test_no_rank_reads_tiles_of_another_merge(slow, tmp_path):
    first, second = results_of(run_ranks(ranks.races, 2, tmp_path / "ranks", tmp_path / "site", slow))
    alone, both, emaps = SiteMap(0.1), ranks.small_map(2, (30, 26)), [ranks.one_robot(rank) for rank in range(2)]
    for merge in range(3):
        ranks.fill(both, [(0, 0), (10, 0)], lambda x, y: 0.1 * x)
        both.state.elapsed.add_(10**9)
        alone.merge(both)
        for emap, seen in zip(emaps, (first, second), strict=True):
            xy = emap.cell_centers()[0].flatten(0, 1)
            np.testing.assert_allclose(seen[merge], alone.sample(xy, "variance", "nearest")[0], rtol=1e-5)


@pytest.mark.slow(2)
@pytest.mark.parametrize("how", ["exits 1", "exits 0 in memory", "killed 0", "hangs 1", "before_commit 0"])
def test_a_rank_that_ends_leaves_the_last_merge_and_an_error(how, tmp_path):
    lost, path = int(how.split()[1]), None if "memory" in how else tmp_path / "site"
    results = run_ranks(ranks.lose, 3, tmp_path / "ranks", path, how)
    expected = SiteMap(0.1)
    both = ranks.small_map(3, (30, 26))
    expected.merge(ranks.fill(both, [(0, 0), (10, 0), (20, 0)], lambda x, y: 0.1 * x))
    assert results[lost] is None
    for texts, seconds, contents in (result for rank, result in enumerate(results) if rank != lost):
        assert len(texts) == 2 and texts[0] == texts[1] and seconds < 20.0
        assert texts[0].startswith("merge: a rank has ended or did not answer within the timeout")
        assert "as of the last merge that rank 0 committed: end all ranks" in texts[0]
        assert_same(contents, ranks.contents(expected))
    if path:
        site = SiteMap(0.1, path)
        assert_same(ranks.contents(site), ranks.contents(expected))
        assert site.merge(both).new_cells.all()


EXPECTED = {
    "resolution": "resolution: must be the same on all ranks, got 0.1 on rank 0 and 0.2 on rank 1",
    "no resolution": "rank 1: resolution: must be a positive number, got -0.1",
    "cfg": "cfg.gate: must be the same on all ranks, got 5.0 on rank 0 and 6.0 on rank 1",
    "path": "path: must be the same on all ranks, got in memory on rank 0 and on disk on rank 1",
    "absent": "rank 1: path: must be a folder that all ranks see",
    "another site": "path: id of the site: must be the same on all ranks",
    "site's resolution": "rank 0: resolution: must be 0.1 m, that of",
    "emap's resolution": "rank 1: emap: must have the site's resolution, 0.1 m, got 0.05 m; cells must line up",
    "window": "size of the window: must be the same on all ranks, got [30, 26] on rank 0 and [30, 28] on rank 1",
    "type": "rank 1: emap: must be an ElevationMap, got str; give an ElevationMap",
    "align": "align: must be the same on all ranks, got True on rank 0 and False on rank 1",
    "tilt": "tilt: must be the same on all ranks, got False on rank 0 and True on rank 1",
    "given": "time: must be the same on all ranks, got not given on rank 0 and given on rank 1",
    "call": "call: must be the same on all ranks, got SiteMap on rank 0 and merge on rank 1",
    "disk": "cannot be used (the disk is full); all that was stored before is unchanged",
    "reading": "rank 1: tile (0, 0): must be readable",
    "beginning": "rank 0: _alone must succeed",
    "writing": "rank 1: write_tiles must succeed",
}


@pytest.mark.slow(2)
def test_bad_use_raises_the_same_error_on_all_ranks(tmp_path):
    for name in ("site", "other"):
        with SiteMap(0.1, tmp_path / name) as site:
            site.merge(ranks.one_robot(0))
    results = results_of(run_ranks(ranks.misuse, 2, tmp_path / "ranks", tmp_path / "site", tmp_path / "other"))
    for name, text in EXPECTED.items():
        errors = [result[0][name] for result in results]
        assert errors[0] == errors[1] and text in errors[0][1], (name, errors)
    for _, before, after, new_cells in results:
        assert_same(after, before)
        assert min(new_cells) > 0


def test_a_group_that_is_not_initialised_is_refused():
    assert not dist.is_initialized()
    with pytest.raises(ValueError, match="group: must be initialised, got none; call torch.distributed"):
        SiteMap(0.1, group=object())
