"""Laplace's equation in large holes, and its gradient."""

import numpy as np
import pytest
import torch

from tests.filters.filter_cases import (
    assert_batch_is_single,
    random_layer,
)
from tests.filters.inpainting.references import diffusion_reference
from torchelev.filters.inpainting.inpaint import (
    inpaint_diffusion,
)

DTYPES = [torch.float64, torch.float32]  # by tensors; by OpenCV


LARGE = {
    "few": lambda i, j, random: random < 0.002,
    "speckled": lambda i, j, random: random < 0.3,
    "frame": lambda i, j, random: (i == 0) | (i == 39) | (j == 0) | (j == 35),
    "one side": lambda i, j, random: i == 0,
    "corridors": lambda i, j, random: ((j % 5 == 0) & (random < 0.9)) | ((i == 7) & (j == 7)),
    "a shadow": lambda i, j, random: (abs(i - 20) > 9) | (abs(j - 15) > 12),
}


@pytest.mark.slow(2)
@pytest.mark.parametrize("case", LARGE)
@pytest.mark.parametrize("dtype, altitude", [(torch.float64, 0.0), (torch.float32, 300.0)])
def test_diffusion_is_right_to_its_tolerance(case, dtype, altitude):
    """At the default tolerance of 1 mm, whatever the shape of the holes, within the default number of steps."""
    i, j = np.meshgrid(np.arange(40), np.arange(36), indexing="ij")
    rng = np.random.default_rng(1)
    known = LARGE[case](i, j, rng.random((40, 36)))
    heights = altitude + 0.03 * i + 0.5 * (j > i) + rng.normal(0, 0.05, known.shape)
    layer = torch.from_numpy(heights)[None].to(dtype), torch.from_numpy(known)[None]
    got, found = inpaint_diffusion(layer)
    error = np.abs(got[0].double().numpy() - diffusion_reference(layer[0][0].double().numpy(), known))
    assert error.max() < 1e-3 and found.all() and 0 < known.sum() < known.size
    assert inpaint_diffusion(layer, iterations=1)[0].sub(got).abs().max() > 0 or error[~known].max() < 1e-9


def test_diffusion_of_a_map_does_not_depend_on_the_others():
    """The easy one stands still while the hard one goes on."""
    i, j = np.meshgrid(np.arange(40), np.arange(36), indexing="ij")
    random = np.random.default_rng(1).random((40, 36))
    known = torch.from_numpy(np.stack([LARGE[case](i, j, random) for case in ("a shadow", "few", "one side")]))
    heights = torch.from_numpy(np.stack([0.3 * np.sin(0.3 * i) * np.cos(0.2 * j)] * 3))
    assert_batch_is_single(lambda layer: inpaint_diffusion(layer, tolerance=0.01), (heights, known), atol=1e-12)


def test_gradient_of_diffusion_grows_with_what_comes_in():
    values, known = random_layer(3, (2, 6, 5), 0.4)
    values = torch.where(known, values, 0.0).requires_grad_()
    filled, _ = inpaint_diffusion((values, known), tolerance=1e-9)
    (one,) = torch.autograd.grad(filled.sum(), values, retain_graph=True)
    (many,) = torch.autograd.grad(1000 * filled.sum(), values)
    torch.testing.assert_close(many, 1000 * one, atol=1e-4, rtol=0)
    assert one.sum() == pytest.approx(60, abs=1e-6)  # all cells rise with all known ones
