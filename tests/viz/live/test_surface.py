"""The meshes of the live view, and the cell that a click means."""

import io

import numpy as np
import pytest
import trimesh

from torchelev.io.export import SavedMap
from torchelev.viz.live.surface import bound_sheet, find_cell, surface


def ramp(center=(0.0, 0.0, 0.0)):
    """A map of 6 x 4 cells that rises by 0.1 m a cell along x, with one unknown cell, which has an upper bound."""
    heights = np.repeat(0.1 * np.arange(6.0)[:, None], 4, 1)
    bound = heights.copy()
    heights[2, 1], bound[2, 1] = np.nan, 0.5
    return SavedMap({"elevation": heights, "upper_bound": bound}, 0.1, np.array(center), {})


def test_the_surface_has_a_hole_where_the_map_is_unknown():
    far = (1e5, -2e5, 0.0)
    saved, origin = ramp(far), np.array([1e5, -2e5, 0.0])
    colors = np.full((6, 4, 4), 255, np.uint8)
    mesh = trimesh.load(io.BytesIO(surface(saved, colors, origin)), file_type="glb", force="mesh", process=False)
    assert len(mesh.vertices) == 23 and len(mesh.faces) == 2 * (5 * 3 - 4)
    assert mesh.vertices[0] == pytest.approx([-0.25, -0.15, 0.0], abs=1e-6)  # to a micrometre, 200 km away
    assert mesh.vertices[-1] == pytest.approx([0.25, 0.15, 0.5], abs=1e-6)


def test_the_surface_is_matt():
    """A material of metal, glTF's default, shows reflections of an environment, and the page has none."""
    colors = np.full((6, 4, 4), 255, np.uint8)
    mesh = trimesh.load(io.BytesIO(surface(ramp(), colors, np.zeros(3))), file_type="glb", force="mesh", process=False)
    assert (mesh.visual.material.metallicFactor, mesh.visual.material.roughnessFactor) == (0, 1)


def test_an_empty_map_has_no_surface():
    saved = ramp()
    saved.layers["elevation"][:] = np.nan
    assert surface(saved, np.zeros((6, 4, 4), np.uint8), np.zeros(3)) == b""


def test_the_bound_covers_the_hole_alone():
    vertices, triangles = bound_sheet(ramp(), np.zeros(3))
    assert len(triangles) == 6  # of the 8 around the cell, those that have it as a corner
    lifted = vertices[np.unique(triangles)][:, 2].argmax()
    assert vertices[np.unique(triangles)][lifted] == pytest.approx([-0.05, -0.05, 0.5])


@pytest.mark.parametrize("cell", [(0, 0), (3, 2), (5, 3)])
def test_a_click_finds_the_first_cell_on_its_ray(cell):
    saved = ramp((3.0, -2.0, 0.0))
    target = np.array([3.0 + (cell[0] - 2.5) * 0.1, -2.0 + (cell[1] - 1.5) * 0.1, 0.1 * cell[0]])
    for start in ((2.0, -4.0, 5.0), (3.2, -2.0, 9.0)):
        assert find_cell(saved, np.array(start), target - start) == cell


def test_a_click_through_a_hole_finds_no_cell_under_the_surface():
    saved = ramp()
    hole = np.array([-0.05, -0.05, 0.2])
    for start in ((-0.05, -0.05, 2.0), (-1.0, -0.05, 1.5), (-0.05, -1.0, 0.8)):
        assert find_cell(saved, np.array(start), hole - start) is None


def test_a_click_beside_the_map_or_on_the_hole_finds_none():
    saved, up = ramp(), np.array([0.0, 0.0, 2.0])
    assert find_cell(saved, up, np.array([1.0, 1.0, 0.1])) is None
    hole = np.array([-0.05, -0.05, 2.0])
    assert find_cell(saved, hole, np.array([0.0, 0.0, -1.0])) is None
