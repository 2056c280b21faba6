"""Steps in the true ground."""

import torch

from torchelev.sim.steps import find_steps


def test_cells_within_one_and_a_half_of_a_step_are_found():
    x = torch.arange(-5, 6).double() * 0.1 + 0.05
    xy = torch.stack([x, torch.zeros_like(x)], -1)

    def truth(places):
        return 0.1 * (places[..., 0] > 0.02)

    assert torch.equal(find_steps(truth, xy, 0.1, 0.05), (x - 0.02).abs() < 0.15)
    assert not find_steps(truth, xy, 0.1, 0.1).any()


def test_slopes_count_by_their_rise_over_three_cells():
    xy = torch.zeros(1, 2, dtype=torch.float64)
    for gradient, is_step in ((0.9, False), (1.1, True)):
        assert bool(find_steps(lambda p, g=gradient: g * p[..., 0], xy, 0.1, 0.3)) == is_step
