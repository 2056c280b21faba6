"""How a body would stand: against a slow copy that looks at one cell and one heading after the other, and by hand."""

import math

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from torchelev.robot import RobotConfig
from torchelev.traversability.attitude import attitudes
from torchelev.traversability.features import complete, extremes, squashed
from torchelev.traversability.stances import in_cells, stances

CELLS = 0.1  # [m]
ROBOT = RobotConfig(length=0.8, width=0.4, foot_reach=0.1, step_height=0.2, clearance=0.3, max_slope=0.5)


def of_map(heights, known=None, robot=ROBOT, resolution=CELLS):
    """Attitudes (headings, 5, H, W) over a map that has no upper bounds."""
    z = torch.as_tensor(heights, dtype=torch.float64)[None]
    known = torch.ones_like(z) > 0 if known is None else torch.as_tensor(known)[None]
    scales = in_cells(robot, resolution)
    ground = complete(z, known, torch.zeros_like(z), torch.zeros_like(z), torch.zeros_like(known), scales)
    found = attitudes(ground, extremes(ground, scales), scales, robot, resolution)
    return torch.stack([torch.cat(list(attitude)) for attitude in found]).numpy()


def squash(x):
    return math.copysign(x * x / (1 + x * x), x)


def slow(heights, i, j, stance, robot=ROBOT):
    """The attitude of one body over cell (i, j), far from the rim."""

    def around(place, radius):
        a, b = i + place[0], j + place[1]
        return heights[a - radius : a + radius + 1, b - radius : b + radius + 1]

    feet = [around(place, 1).mean() for place in stance.feet]
    a, b, c, d = feet
    length, width = stance.length * CELLS, stance.width * CELLS
    pitch, roll = (a + b - c - d) / 2 / length, (a + c - b - d) / 2 / width
    slope = (pitch**2 + roll**2) / math.tan(robot.max_slope) ** 2

    def steepness(place):
        z = around(place, 1)
        slopes = []
        for rows in (z.mean(1), z.mean(0)):
            before, after = np.diff(rows)
            slopes.append(min(abs(before), abs(after)) if before * after > 0 else 0)
        return min(max(math.hypot(*slopes), 1e-6), math.tan(robot.max_slope) * CELLS)

    step = 0
    for m, n in ((0, 1), (2, 3), (0, 2), (1, 3)):
        first, last = (np.array(stance.feet[k]) for k in (m, n))
        (way,) = (w for w, starts in stance.ways.items() if tuple(first) in starts and w.end == tuple(last - first))
        between = [around(first + place, 1).max() for place in way.places]
        profile = [around(first, 1).mean(), *between, around(last, 1).mean()]
        explained = min(steepness(first), steepness(last)) * (way.spacing + math.sqrt(2))
        for heading in (profile, profile[::-1]):
            highest = heading[0]
            for height in heading[1:]:
                step, highest = max(step, height - highest - explained), max(highest, height)
    radius = in_cells(robot, CELLS).body
    gradient = (pitch, roll)
    if stance.feet[0][0] != stance.feet[1][0] and stance.feet[0][1] != stance.feet[1][1]:
        gradient = (pitch - roll) / math.sqrt(2), (pitch + roll) / math.sqrt(2)
    inclined = sum(map(abs, gradient)) * radius * CELLS
    ahead = math.hypot(*stance.spine[1]) * CELLS * pitch
    tops = [around(place, radius).max() for place in stance.spine]
    highest = max(tops[0], tops[1] - ahead, tops[2] + ahead) - inclined
    belly = (highest - (a + b + c + d) / 4) / robot.clearance
    ratios = slope**0.5, step / robot.step_height, max(0, belly)
    stands = math.prod(1 / (1 + x**8) for x in ratios)
    return [squash(slope), squash(ratios[1]), squash(belly), stands, 1]


@given(st.integers(0, 2**31), st.sampled_from([0.02, 0.2, 1.0]))
def test_is_what_a_loop_finds(seed, roughness):
    heights = roughness * np.random.default_rng(seed).normal(size=(25, 24))
    found = of_map(heights)
    for number, stance in enumerate(stances(ROBOT, CELLS)):
        for i, j in ((12, 11), (11, 13)):
            assert found[number, :, i, j] == pytest.approx(slow(heights, i, j, stance), abs=1e-9)


def along(profile):
    """A map that rises along x by a profile around its middle row, and the attitude of a body across it there."""
    rows = np.interp(np.arange(31) - 15, *zip(*profile, strict=True))
    return of_map(np.repeat(rows[:, None], 31, 1))[0, :, 15, 15]


def test_on_flat_ground_all_is_nothing():
    slope_step_belly, verdict = np.split(of_map(np.full((31, 31), 7.0))[:, :, 10:21, 10:21], [3], 1)
    assert slope_step_belly == pytest.approx(0, abs=1e-12) and verdict == pytest.approx(1)


@pytest.mark.slow(1)
@pytest.mark.parametrize("resolution", [0.02, 0.04, 0.08, 0.1])
@pytest.mark.parametrize("heading", [0.0, 0.3, math.pi / 4, 2.0])
@pytest.mark.parametrize(("tilt", "stands"), [(0.4, True), (0.62, False)])
def test_a_plane_is_no_step_and_stands_if_it_is_gentle(resolution, heading, tilt, stands):
    cells = 2 * round(1.0 / resolution) + 1
    x, y = np.meshgrid(*[(np.arange(cells) - cells // 2) * resolution] * 2, indexing="ij")
    heights = math.tan(tilt) * (math.cos(heading) * x + math.sin(heading) * y)
    slope, step, belly, verdict, _ = of_map(heights, resolution=resolution)[:, :, cells // 2, cells // 2].T
    assert slope == pytest.approx(squash((math.tan(tilt) / math.tan(0.5)) ** 2))
    assert (belly < 1e-9).all()
    assert (verdict > 0.8).all() and (step < 1e-9).all() if stands else (verdict < 0.2).all()


@pytest.mark.parametrize("height", [0.1, 0.25])
def test_a_bar_between_the_feet_is_a_step_and_a_hole_is_none(height):
    bar, hole = (along([(-2, 0), (-1, 0), (0, sign * height), (1, 0), (2, 0)]) for sign in (1, -1))
    assert bar[1:3] == pytest.approx([squash(height / ROBOT.step_height), squash(height / ROBOT.clearance)], abs=1e-4)
    assert bar[3] > 0.99 if height < ROBOT.step_height else bar[3] < 0.15
    assert hole[1:3] == pytest.approx(0, abs=1e-9) and hole[3] > 0.9


def test_each_riser_of_a_stair_counts_by_itself():
    """0.3 m from front to hind feet, in two risers, each read in a window of its own."""
    step = along([(-2, 0), (-1.99, 0.15), (1, 0.15), (1.01, 0.3)])[1]
    assert step == pytest.approx(squash(0.15 / ROBOT.step_height), abs=1e-4)


def test_ground_beyond_what_is_known_is_no_step():
    """A hole too large to complete, in ground that is below the map's mean: what is in it is not known."""
    heights, known = np.zeros((61, 31)), np.ones((61, 31), dtype=bool)
    heights[40:], known[11:20, 11:20] = 3.0, False
    step = of_map(heights, known)[:, 1]
    assert step[:, 6:25, 6:25] == pytest.approx(0, abs=1e-9)


def test_with_a_foot_on_a_stone_it_leans():
    heights = np.zeros((31, 31))
    heights[18:21, 16:19] = 0.2  # under the front left foot of a body at (15, 15)
    slope = of_map(heights)[0, 0, 15, 15]
    assert slope == pytest.approx(squash(((0.1 / 0.8) ** 2 + (0.1 / 0.4) ** 2) / math.tan(0.5) ** 2))


def test_nothing_is_told_beyond_the_completed_ground():
    known = np.zeros((40, 31), dtype=bool)
    known[:6] = True
    heights = np.random.default_rng(0).normal(size=known.shape)
    found = of_map(heights, known)
    # Half the body's length completes 4 more rows; front feet are 4 rows ahead, and reach 1.
    assert (found[0, :, 5:] == 0).all() and (found[0, :, 4, 4:-4] != 0).any()


@given(st.floats(-1e30, 1e30))
def test_squashed_is_odd_steep_at_one_and_bounded(ratio):
    x = torch.tensor([ratio, -ratio, 0.8, 1.25], dtype=torch.float32)
    got = squashed(x)
    assert got[0] == -got[1] and got[0].abs() <= 1 and got[3] - got[2] > 0.2
