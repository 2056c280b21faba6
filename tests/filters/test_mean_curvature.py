"""Curvature of bowls, lines and corners."""

import pytest
import torch
from hypothesis import strategies as st

from tests.filters.terrains import random_layer, terrain
from torchelev.filters.registry import FILTERS

SEEDS = st.integers(0, 10_000)


@pytest.mark.parametrize("resolution", [0.02, 0.04, 0.08])
def test_curvature_of_quadratics(resolution):
    """A bowl of radius 0.5 m bends by 2 / m, a bump by less than 0; a gutter by half, a saddle not at all."""
    shapes = {2.0: lambda x, y: x * x + y * y, -2.0: lambda x, y: -x * x - y * y + 0.3 * x}
    shapes |= {1.0: lambda x, y: x * x, 0.0: lambda x, y: x * x - y * y + 3 * x * y}
    for bend, function in shapes.items():
        layer, _, _ = terrain(function, resolution, 1.6)
        result, _ = FILTERS["curvature"](layer, resolution=resolution, radius=0.16)
        inner = round(0.16 / resolution)
        torch.testing.assert_close(
            result[:, inner:-inner, inner:-inner],
            torch.full_like(result, bend)[:, inner:-inner, inner:-inner],
            atol=1e-9,
            rtol=0,
        )


@pytest.mark.parametrize("dtype, tolerance", [(torch.float64, 1e-9), (torch.float32, 0.02)])
def test_curvature_of_a_bowl_with_unknown_cells(dtype, tolerance):
    (z, _), _, _ = terrain(lambda x, y: x * x + y * y + 300 * (dtype == torch.float64), 0.04, 1.6)
    known = random_layer(5, z.shape, 0.5)[1]
    result, _ = FILTERS["curvature"]((z.to(dtype), known), resolution=0.04, radius=0.16)
    torch.testing.assert_close(result[known], torch.full_like(result[known], 2.0), atol=tolerance, rtol=0)


def test_a_line_of_cells_bends_along_itself():
    """z = x^2, of which a row is known, or one that lies across: 2 / m."""
    x = torch.arange(7, dtype=torch.float64) * 0.1
    row, known = torch.zeros(1, 7, 7, dtype=torch.float64), torch.zeros(1, 7, 7, dtype=torch.bool)
    row[0, :, 3], known[0, :, 3] = x * x, True
    diagonal = torch.diag(2 * x * x)[None], torch.eye(7, dtype=torch.bool)[None]
    for layer in ((row, known), (row.mT, known.mT), diagonal):
        result, _ = FILTERS["curvature"](layer, resolution=0.1, radius=0.2)
        torch.testing.assert_close(result[layer[1]], torch.full((7,), 2.0, dtype=torch.float64))


def test_what_little_is_known_does_not_bend():
    """Two or three cells of an alpine valley: no plane is left over to bend."""
    z = torch.tensor([[[5.0, 0.0, 0.0], [0.0, 9.0, 0.0], [0.0, 0.0, 0.0]]])
    known = torch.zeros(1, 3, 3, dtype=torch.bool)
    known[0, 0, 0] = known[0, 1, 1] = known[0, 0, 1] = True
    assert not FILTERS["curvature"]((z, known), resolution=0.1, radius=0.1)[0].any()
