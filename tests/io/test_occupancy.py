"""Costs of Nav2 from the traversability."""

import numpy as np
import pytest
import torch

from tests.helpers import small_map
from tests.levels.walks import line, make_map, walk
from torchelev import LevelsConfig
from torchelev.io.occupancy import to_occupancy_grid
from torchelev.planning.traversal_cost import TraversalCostConfig, traversal_cost
from torchelev.sim.exact import covered_scenes


def rated(values, corner=(0, 0), **settings):
    """A map with these traversabilities (H, W), NaN where not rated."""
    values = torch.tensor(values)
    emap = small_map(cells=tuple(values.shape), resolution=0.5, **settings)
    known = torch.isfinite(values)[None]
    ratings = torch.where(known, values[None], 0.0)
    emap.load_state(
        emap.state._replace(corner=torch.tensor([corner]), validity=known, rated=known, traversability=ratings)
    )
    return emap


def test_costs_by_hand():
    """x grows along rows of the tensor and within rows of the message; 98 (1 - t) / (1 - 0.5)."""
    grid = to_occupancy_grid(rated([[1.0, 0.75], [0.5, 0.49], [0.0, torch.nan]], corner=(20, 40)))
    assert grid.data.tolist() == [0, 98, 100, 49, 100, -1] and grid.data.dtype == np.int8
    assert (grid.info.width, grid.info.height, grid.info.resolution) == (3, 2, 0.5)
    assert grid.info.origin.position[:2] == (10.0, 20.0)


def test_the_threshold():
    values = [[0.9, 0.2]]
    assert to_occupancy_grid(rated(values), min_traversability=0.0).data.tolist() == [10, 78]
    assert to_occupancy_grid(rated(values), min_traversability=0.95).data.tolist() == [100, 100]
    for wrong in (-0.1, 1.0):
        with pytest.raises(ValueError, match="min_traversability: must be at least 0 and less than 1"):
            to_occupancy_grid(rated(values), min_traversability=wrong)


def test_cells_below_low_ceilings_are_lethal_where_the_planner_does_not_go():
    emap = make_map()
    walk(emap, covered_scenes.table(), line((-1.5, 0.0, 0.0), (0.5, 0.0, 0.0), 5))
    clearance = emap.layer("clearance")[0].numpy()
    for height, lowest in ((None, 0.4), (0.3, 0.4), (0.9, 0.9)):
        costs = to_occupancy_grid(emap, height=height).data.reshape(clearance.shape[::-1]).T
        low = clearance < lowest - 1e-3
        assert (costs[low] == 100).all() and (low.any() or lowest == 0.4)
        by_default = to_occupancy_grid(emap).data.reshape(clearance.shape[::-1]).T
        assert np.array_equal(costs[~low], by_default[~low])
        impassable = traversal_cost(emap, TraversalCostConfig(height=height))[0].isinf().numpy()
        assert impassable[low].all()


def test_a_height_needs_levels():
    for emap in (rated([[0.9]]), make_map(levels=LevelsConfig(max_levels=1))):
        assert to_occupancy_grid(emap) is not None
        with pytest.raises(ValueError, match="height: needs a map with levels"):
            to_occupancy_grid(emap, height=0.5)


def test_spaces_that_are_too_low_are_lethal_as_in_planning():
    """Infinite: nothing hangs there; NaN: nobody looked. Half a millimetre is rounding."""
    ceilings = torch.tensor([[0.3, 0.398, 0.3995, 1.0], [torch.inf, torch.nan, 0.3, torch.nan]])
    ratings = [[1.0, 0.75, 1.0, 1.0], [1.0, 1.0, torch.nan, torch.nan]]
    emap = rated(ratings, levels=LevelsConfig(min_gap=0.4))
    emap.load_state(emap.state._replace(validity=torch.ones_like(emap.validity)))  # but for the ratings, all is known
    levels = emap.levels.in_windows(emap.state)
    lower, support, top = (torch.zeros_like(values) for values in (levels.lower, levels.support, levels.free_top))
    lower[:, 0], support[:, 0] = ceilings.nan_to_num(0.0, 0.0), 10.0 * ceilings.isfinite()
    top[:] = 10.0 * ceilings.isinf()
    emap.load_state(emap.state, levels._replace(lower=lower, upper=lower, support=support, free_top=top))
    np.testing.assert_array_equal(emap.layer("clearance")[0], ceilings)
    costs = to_occupancy_grid(emap).data.reshape(4, 2).T
    assert costs.tolist() == [[100, 100, 0, 0], [0, 0, 100, -1]]
    is_closed = torch.isinf(traversal_cost(emap, TraversalCostConfig(inflation_radius=0.0)))[0].numpy()
    assert np.array_equal(is_closed, costs == 100)
