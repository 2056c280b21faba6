"""The height update."""

import dataclasses

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from tests import reference
from tests.devices import unread
from tests.helpers import off_borders, pose, random_poses, random_state, scan, small_map
from torchelev import EdgeConfig, FusionConfig, SensorConfig
from torchelev.stages.fusion.stage import fuse

SEEDS = st.integers(0, 10_000)
CELLS = (6, 5)
FUSED = ("elevation", "variance", "support", "challenger", "challenger_support", "time")


def steps_and_outliers(rng, num_points):
    """Map-frame points (N, 3) over the window: ground, a block with steps within cells, outliers, some outside."""
    xy = off_borders(rng.uniform(-0.35, 0.35, (num_points, 2)), 0.1, 0.02)
    z = rng.normal(0, 0.01, num_points)
    z[xy[:, 0] > 0.13] += 0.3
    outliers = rng.random(num_points) < 0.15
    z[outliers] += rng.uniform(-0.5, 0.5, outliers.sum())
    return np.column_stack([xy, z])


def reference_fuse(state, points, variances, used, origins, b, cfg):
    """The reference's cells of environment b after a scan, and the numbers of points used and ignored."""
    corner, shape = state.corner[b].tolist(), CELLS
    by_cell = {}
    for p, variance, u, origin in zip(points, variances, used, origins, strict=True):
        c = reference.cell_of(p[0], p[1], corner, 0.1, shape)
        if u and c is not None:
            beyond = reference.passed_center(p[0], p[1], origin, corner, 0.1, shape)
            ray = (p[0] - origin[0], p[1] - origin[1])
            by_cell.setdefault(c, []).append(dict(z=p[2], variance=variance, ray=ray, beyond=beyond))
    results, means = {}, {c: reference.weighted_mean(points) for c, points in by_cell.items()}
    for c in np.ndindex(*shape):
        around = [(c[0] + i, c[1] + j) for i in (-1, 0, 1) for j in (-1, 0, 1) if i or j]
        inside = [a for a in around if 0 <= a[0] < shape[0] and 0 <= a[1] < shape[1]]
        known = {(a[0] - c[0], a[1] - c[1]): float(state.elevation[b][a]) for a in inside if state.validity[b][a]}
        shown = max(means.get(a, -np.inf) for a in inside), known
        cell = {n: float(getattr(state, n)[b][c]) for n in FUSED}
        cell["known"] = bool(state.validity[b][c])
        window = [tuple(float(getattr(state, n)[b][a]) for n in FUSED) for a in [c, *inside] if state.validity[b][a]]
        settled = max((v[0] for v in window if v[2] >= cfg.max_support / 2), default=-np.inf)
        challengers = sum(float(state.challenger_support[b][a]) > 0 for a in [c, *inside])
        settings = dict(dataclasses.asdict(cfg), shown=shown, settled=settled, challengers=challengers)
        del settings["averaging"]
        results[c] = reference.fuse_cell(cell, by_cell.get(c, []), 0.1, **settings)
    return results


PLAIN = FusionConfig(edges=None)


@pytest.mark.slow(1)
@given(
    SEEDS,
    st.sampled_from([30, 200, 500]),
    st.integers(1, 2),
    st.sampled_from([PLAIN, dataclasses.replace(PLAIN, scan_variance_floor=1e-3, max_support=3.0)]),
)
def test_agrees_with_the_reference(seed, num_points, sensors, cfg):
    compare_with_reference(seed, num_points, sensors, cfg)


# Without a margin, rounding decides whether a single point reaches its own mean.
EDGES = [EdgeConfig(), EdgeConfig(min_extreme=1, refinements=2), EdgeConfig(min_extreme=4, refinements=3, margin=1e-6)]


@pytest.mark.slow(1)
@given(
    SEEDS,
    st.sampled_from([200, 500]),
    st.integers(1, 2),
    st.sampled_from(EDGES),
    st.booleans(),
    st.sampled_from([0.0, -5.0]),
)
def test_agrees_with_the_reference_at_steps(seed, num_points, sensors, edges, can_select, altitude):
    """On a CPU, which selects the contested cells, and as on a GPU, which goes through all cells."""
    compare_with_reference(seed, num_points, sensors, FusionConfig(edges=edges), altitude, can_select)


@pytest.mark.parametrize("can_select", [True, False])
def test_no_cell_is_contested(can_select):
    """Other cells keep their heights: with no points at all, and where all points agree with the map."""
    emap, T = small_map(1, CELLS), pose((0.0, 0.0, 1.0))
    flat = torch.tensor([[[x, y, -1.0] for x in (-0.15, 0.05) for y in (-0.15, 0.05)]]).repeat(1, 5, 1)
    state = emap.state if can_select else unread(emap.state)
    state = emap(state, emap.measure(flat[:, :0], T, None, 0.0))
    assert not state.validity.any()
    for _ in range(2):
        state = emap(state, emap.measure(flat, T, None, 0.0))
    assert state.elevation[state.validity].tolist() == pytest.approx([0.0] * 4, abs=1e-6)
    assert state.statistics.points_used.item() == 20


def compare_with_reference(seed, num_points, sensors, cfg, altitude=0.0, can_select=True):
    rng = np.random.default_rng(seed)
    emap = small_map(2, CELLS, dtype=torch.float64)
    state = random_state(rng, emap.cfg.grid, 2)
    state = state._replace(elevation=torch.where(state.validity, state.elevation * 0.1 + altitude, 0.0))
    T = torch.stack([random_poses(rng, sensors, reach=1.0) for _ in range(2)])
    in_map = np.stack([[steps_and_outliers(rng, num_points) for _ in range(sensors)] for _ in range(2)])
    T[..., 2, 3] += altitude
    in_map[..., 2] += altitude
    cloud = (torch.from_numpy(in_map) - T[:, :, None, :3, 3]) @ T[:, :, :3, :3]
    m = emap.measure(cloud, T, None, 0.1)
    grid = emap.cfg.grid
    after = fuse(*(state, m) if can_select else unread((state, m)), grid, cfg, has_rays=True)
    for b in range(2):
        points = in_map[b].reshape(-1, 3)
        origins = np.repeat(T[b, :, :3, 3].numpy(), num_points, 0)
        results = reference_fuse(state, points, m.variance[b].tolist(), m.used[b].tolist(), origins, b, cfg)
        for c, (cell, _, _) in results.items():
            got = {n: float(getattr(after, n)[b][c]) for n in FUSED}
            assert got == pytest.approx({n: cell[n] for n in got}, abs=1e-9), c
            assert bool(after.validity[b][c]) == cell["known"]
        assert after.statistics.points_used[b] == sum(used for _, used, _ in results.values())
        assert after.statistics.rejected_edge[b] == sum(ignored for _, _, ignored in results.values())
    counted = sum(getattr(after.statistics, n) for n in ("points_used", "rejected_edge", "rejected_outlier"))
    assert torch.equal(counted + after.statistics.rejected_outside, m.used.sum(1))


def test_the_reference_meets_every_branch():
    """Or the agreement above would say little: used points, outliers, steps, outvoted and newly founded cells."""
    rng = np.random.default_rng(0)
    emap = small_map(1, CELLS, dtype=torch.float64)
    seen = dict(used=0, ignored=0, raised=0, refounded=0, founded=0)
    for _ in range(10):
        state = random_state(rng, emap.cfg.grid)
        points = steps_and_outliers(rng, 300)
        every = ([1e-4] * 300, [True] * 300, [np.array([-1.0, 0, 1])] * 300)
        for c, (cell, used, ignored) in reference_fuse(state, points, *every, 0, FusionConfig()).items():
            known, variance = state.validity[0][c], float(state.variance[0][c])
            seen["used"] += used
            seen["ignored"] += ignored
            seen["raised"] += bool(known and cell["variance"] > variance and not used)
            seen["refounded"] += bool(known and used and abs(cell["elevation"] - float(state.elevation[0][c])) > 0.2)
            seen["founded"] += bool(not known and used)
    assert all(seen.values()), seen


# The paper's equations ------------------------------------------------------------------------------------------------


def scan_of(emap, heights, variance):
    """Fuse points in the middle of the only cell, map frame heights, with a variance each."""
    cloud = torch.zeros(1, len(heights), 3, dtype=torch.float64) + 0.5
    cloud[0, :, 2] = torch.tensor(heights, dtype=torch.float64) - 5.0
    variances = torch.as_tensor(variance, dtype=torch.float64).expand(1, len(heights))
    emap.update(cloud, pose((0, 0, 5.0)), dt=0.0, variance=variances)


def one_cell(**fusion):
    return small_map(
        1,
        (1, 1),
        1.0,
        torch.float64,
        drift=None,
        sensor=SensorConfig(exclusion=None),
        fusion=FusionConfig(**{"relief": 1e-3, "edges": None, "scan_variance_floor": 1e-12, **fusion}),
    )


@pytest.mark.slow(1)
@given(SEEDS, st.integers(1, 8), st.integers(1, 4))
def test_equals_the_papers_equations_point_after_point(seed, num_points, scans):
    """Equations (1) and (2): in information form there is no order, and many points of a scan are one sum."""
    rng = np.random.default_rng(seed)
    emap = one_cell(max_gate_std=10.0)
    scan_of(emap, [0.0], 0.04)
    h, variance = 0.0, 0.04
    for _ in range(scans):
        heights, variances = rng.uniform(-0.1, 0.1, num_points), rng.uniform(0.01, 0.09, num_points)
        scan_of(emap, heights.tolist(), torch.from_numpy(variances)[None])
        h, variance = reference.kalman(h, variance, zip(heights, variances, strict=True))
        assert float(emap.elevation) == pytest.approx(h, abs=1e-12)
        assert float(emap.variance) == pytest.approx(variance, rel=1e-9)


def test_a_scan_is_no_more_certain_than_its_pose():
    emap = one_cell(scan_variance_floor=1e-3)
    scan_of(emap, [0.0] * 1000, 1e-4)
    assert float(emap.variance) == pytest.approx(1e-3)
    scan_of(emap, [0.0] * 1000, 1e-4)
    assert float(emap.variance) == pytest.approx(5e-4)


@pytest.mark.parametrize("sigmas, taken", [(2.9, True), (3.1, False)])
def test_the_gate_is_a_distance_in_standard_deviations(sigmas, taken):
    """Not in variances, as the paper's open code has it: sqrt(0.03^2 + 0.04^2) = 0.05."""
    emap = one_cell(max_gate_std=1.0, relief=1e-9)
    scan_of(emap, [0.0], 0.03**2)
    scan_of(emap, [sigmas * 0.05], 0.04**2)
    assert (float(emap.elevation) > 0) == taken
    assert emap.statistics.rejected_outlier.item() == (not taken)


def test_an_outlier_raises_the_variance_and_many_found_the_cell_anew():
    emap = one_cell(outlier_variance=1e-4)
    scan_of(emap, [0.0] * 4, 1e-4)
    before = float(emap.variance)
    scan_of(emap, [1.0], 1e-4)
    assert float(emap.variance) == pytest.approx(before + 1e-4) and float(emap.elevation) == 0.0
    for _ in range(5):
        scan_of(emap, [1.0], 1e-4)
    assert float(emap.elevation) == pytest.approx(1.0)


def test_an_outlier_that_founds_a_cell_is_outvoted():
    emap = one_cell()
    scan_of(emap, [1.0], 1e-4)
    for _ in range(3):
        scan_of(emap, [0.0, 0.001], 1e-4)
    assert float(emap.elevation) == pytest.approx(0.0, abs=1e-3)


def test_the_variance_stays_below_its_maximum():
    emap = one_cell(max_variance=0.01, outlier_variance=1.0)
    scan_of(emap, [0.0] * 5, 0.5)
    assert float(emap.variance) == 0.01
    scan_of(emap, [50.0], 1e-4)
    assert float(emap.variance) == 0.01


def test_float32_keeps_millimetres_at_altitude():
    emap = small_map(1, (1, 1), 1.0, drift=None)
    for _ in range(5):
        emap.update(torch.tensor([[[0.5, 0.5, -1.0], [0.4, 0.5, -1.002]]]), pose((0, 0, 4001.0)), dt=0.1)
    assert float(emap.layer("elevation").double()) == pytest.approx(4000.0 - 0.001, abs=5e-4)


# New obstacles --------------------------------------------------------------------------------------------------------


def settled(**fusion):
    emap = one_cell(**fusion)
    for _ in range(100):
        scan_of(emap, [0.0, 0.001], 1e-4)
    return emap


@pytest.mark.slow(2)
@pytest.mark.parametrize("points, scans", [(1, 5), (2, 3), (20, 3)])
def test_points_that_agree_win_in_a_few_scans(points, scans):
    """However settled the cell is, but never by a single bad scan."""
    emap = settled()
    for _ in range(scans):
        assert float(emap.elevation) < 0.01
        scan_of(emap, [0.3] * points, 1e-4)
    assert float(emap.elevation) == pytest.approx(0.3)


@pytest.mark.slow(1)
def test_points_that_scatter_lose():
    """Even where nothing else is hit, for as many as the cell's support."""
    emap = settled()
    for height in np.linspace(0.2, 2.0, 19):
        scan_of(emap, [height], 1e-4)
        scan_of(emap, [2.2 - height], 1e-4)
    assert float(emap.elevation) < 0.01


def scan_cells(emap, heights):
    """Fuse a point in the middle of each cell (3, 3), none where NaN."""
    x, y = np.meshgrid((-0.5, 0.5, 1.5), (-0.5, 0.5, 1.5), indexing="ij")
    cloud = torch.from_numpy(np.stack([x, y, np.asarray(heights, dtype=float) - 5.0], -1).reshape(1, 9, 3))
    emap.update(cloud, pose((0.0, 0.0, 5.0)), dt=0.0, variance=torch.full((1, 9), 1e-4, dtype=torch.float64))


def settled_cells(heights):
    emap = small_map(1, (3, 3), 1.0, drift=None, fusion=FusionConfig(relief=0.01), dtype=torch.float64)
    for _ in range(100):
        scan_cells(emap, heights)
    return emap


@pytest.mark.slow(1)
@pytest.mark.parametrize("columns, wins", [(2, True), (1, False)])
def test_a_face_that_shows_at_all_heights_wins_where_cells_beside_it_rise_too(columns, wins):
    emap = settled_cells(np.zeros((3, 3)))
    face = np.zeros((3, 3))
    for height in (0.5, 0.9, 1.3, 1.7, 2.1, 2.5):
        face[:, :columns] = height
        scan_cells(emap, face)
    assert bool(emap.elevation[0, 1, 0] > 0.4) == wins
    assert float(emap.elevation[0, :, columns:].max()) < 0.01


@pytest.mark.slow(1)
@pytest.mark.parametrize("step, flips", [(0.3, False), (0.0, True)])
def test_the_edge_of_a_known_step_stays_where_it_was(step, flips):
    """A few scans from another view hit its top in the cell before it; without the step they are a new obstacle."""
    emap = settled_cells([[0.0, 0.0, step]] * 3)
    for _ in range(8):
        scan_cells(emap, [[0.0, 0.3, step]] * 3)
    assert bool(emap.elevation[0, 1, 1] > 0.2) == flips


@pytest.mark.slow(1)
def test_ground_that_is_still_hit_takes_a_challengers_points_off():
    emap = settled()
    for _ in range(20):
        scan_of(emap, [0.3], 1e-4)
        scan_of(emap, [0.0], 1e-4)
    assert float(emap.elevation) < 0.01


# Edges ----------------------------------------------------------------------------------------------------------------


def at_wall(start, edges):
    """Map the foot and top of a 0.5 m wall that begins at `start` within the only 0.1 m cell, seen along +x."""
    rng = np.random.default_rng(0)
    x = np.linspace(0.001, 0.099, 60)
    z = np.where(x > start, 0.5, 0.0) + rng.normal(0, 0.002, 60)
    points = torch.from_numpy(np.column_stack([x, rng.uniform(0.03, 0.07, 60), z]))
    sensor = SensorConfig(noise_factor=0.0, noise_floor=4e-6)
    emap = small_map(1, (1, 1), 0.1, fusion=FusionConfig(edges=edges), raycast=None, sensor=sensor, drift=None)
    T = pose((-2.0, 0.05, 2.0))
    emap.update((points - T[0, :3, 3])[None].float(), T, dt=0.1)
    return emap


@pytest.mark.parametrize("start, height", [(0.02, 0.5), (0.04, 0.5), (0.085, 0.0), (0.09, 0.0)])
def test_a_wall_stays_sharp(start, height):
    """The top wins over the foot and face, unless the wall begins beyond the cell's centre."""
    emap = at_wall(start, EdgeConfig())
    assert emap.layer("elevation").item() == pytest.approx(height, abs=0.005)
    assert emap.statistics.rejected_edge.item() > 0 or min(start, 0.1 - start) < 0.025


@pytest.mark.parametrize("start, height", [(0.03, 0.5), (0.07, 0.0)])
def test_a_wall_that_begins_beyond_the_centre_leaves_the_ground(start, height):
    """Rays passed over the centre and hit the ground; the wall shows in the next cell."""
    rng = np.random.default_rng(0)
    x = np.linspace(0.001, 0.199, 120)
    z = np.where(x > start, 0.5, 0.0) + rng.normal(0, 0.002, 120)
    points = torch.from_numpy(np.column_stack([x, rng.uniform(0.048, 0.052, 120), z]))
    emap = small_map(1, (4, 1), 0.1, raycast=None, sensor=SensorConfig(noise_factor=0.0), drift=None)
    T = pose((-0.19, 0.05, 2.0))
    emap.update((points - T[0, :3, 3])[None].float(), T, dt=0.1)
    assert emap.layer("elevation")[0, 2:, 0].tolist() == pytest.approx([height, 0.5], abs=0.005)


def test_without_edges_nothing_is_ignored():
    assert at_wall(0.04, None).statistics.rejected_edge.item() == 0


def test_noise_is_no_step():
    """Flat noisy ground: no point is ignored as edge, and there is no bias."""
    rng = np.random.default_rng(0)
    emap = small_map(1, (10, 10), drift=None)
    T = pose((0, 0, 1.0))
    ignored = 0
    for _ in range(10):
        xy = rng.uniform(-0.5, 0.5, (3000, 2))
        distance = np.sqrt((xy**2).sum(1) + 1)
        z = rng.normal(0, np.sqrt(1e-4 * distance**2 + 2.5e-5))
        emap.update(torch.from_numpy(np.column_stack([xy, z - 1]))[None], T, dt=0.1)
        ignored += emap.statistics.rejected_edge.item()
    assert ignored == 0
    assert abs(emap.layer("elevation").mean().item()) < 5e-4


def test_the_time_of_cells_never_hit_may_be_infinite():
    emap = small_map(1)
    emap.time.fill_(torch.inf)
    cloud, T = scan(0, 1, 60)
    emap.update(cloud, T, T, 0.1)
    assert not emap.time.isnan().any() and emap.validity.any() and not emap.time[emap.validity].any()


def test_points_that_are_ignored_may_have_any_variance():
    """Even one whose inverse is infinite."""
    cloud, T = scan(0, 2, 60)
    cloud[:, ::3] = torch.nan
    maps = [small_map(2), small_map(2)]
    for emap, small in zip(maps, (1e-39, 1e-4), strict=True):
        emap.update(cloud, T, T, 0.1, variance=torch.where(cloud[..., 0].isnan(), small, 1e-4))
    assert maps[0].validity.any()
    for layers in zip(*(emap.state[:-1] for emap in maps), strict=True):
        torch.testing.assert_close(*layers, rtol=0, atol=0)


def test_an_infinite_outlier_variance_is_the_largest():
    """Of cells that a scan disagrees with; the others keep theirs."""
    maps = [
        small_map(1, fusion=FusionConfig(outlier_variance=value)) for value in (np.inf, FusionConfig().max_variance)
    ]
    for emap in maps:
        for seed, height in ((0, 0.0), (1, 0.5)):
            cloud, T = scan(seed, 1, 20)
            cloud[..., 2] += height
            emap.update(cloud, T, T, 0.1)
    assert maps[0].variance.isfinite().all() and torch.equal(maps[0].variance, maps[1].variance)
