"""What is written of a map can be read back, and lies where the map lay."""

import dataclasses

import numpy as np
import plyfile
import pytest
import torch

from tests.helpers import small_config
from torchelev import ElevationMap, ElevationMapConfig, GridConfig
from torchelev.filters import FilterConfig, register
from torchelev.io.export import load_npz, save_cloud, save_mesh, save_npz, take, to_mesh, to_points, triangulate


@pytest.fixture
def emap():
    """Two maps of 2 x 1 m; the second knows a slope rising with x, and nothing beyond y = 20.3."""
    config = ElevationMapConfig(grid=GridConfig(resolution=0.1, length_x=2.0, length_y=1.0))
    emap = ElevationMap(config, num_envs=2)
    x, y = torch.meshgrid(torch.arange(-1, 1, 0.025), torch.arange(-0.5, 0.3, 0.025), indexing="ij")
    points = torch.stack([x, y, 0.5 * x - 1.0], -1).reshape(1, -1, 3) + 1e-4
    pose = torch.eye(4, dtype=torch.float64).repeat(2, 1, 1)
    pose[1, :3, 3] = torch.tensor([10.0, 20.0, 3.0])
    cloud = torch.cat([torch.full_like(points, torch.nan), points])
    emap.update(cloud, pose, pose, dt=0.0)
    return emap


def test_npz_round_trip(tmp_path, emap):
    save_npz(tmp_path / "map.npz", emap, env=1)
    saved = load_npz(tmp_path / "map.npz")
    for name, values in saved.layers.items():
        np.testing.assert_array_equal(values, emap.layer(name)[1].numpy())
    assert {"elevation", "variance", "validity", "time", "upper_bound", "traversability", "normal_x"} <= set(
        saved.layers
    )
    assert saved.resolution == 0.1 and saved.center.tolist() == emap.center[1].tolist()
    assert saved.extent == pytest.approx((9, 11, 19.5, 20.5))
    assert ElevationMapConfig.from_dict(saved.config) == emap.cfg
    assert np.isnan(saved.layers["elevation"]).any() and "i grows with +x" in saved.axes


def test_npz_keeps_the_name_it_is_given(tmp_path, emap):
    save_npz(tmp_path / "map.data", emap)
    assert load_npz(tmp_path / "map.data").resolution == 0.1


def test_refuses_another_npz(tmp_path):
    np.savez(tmp_path / "cloud.npz", points=np.zeros((2, 3)))
    with pytest.raises(ValueError, match=r"cloud\.npz: not a map, axes, center"):
        load_npz(tmp_path / "cloud.npz")


def test_mesh_lies_on_the_map_with_normals_up(tmp_path, emap):
    count = save_mesh(tmp_path / "map.ply", emap, env=1)
    data = plyfile.PlyData.read(tmp_path / "map.ply")
    vertices = np.stack([data["vertex"][axis] for axis in "xyz"], axis=-1)
    triangles = np.stack(data["face"]["vertex_indices"])
    assert len(triangles) == count == 2 * 19 * 7
    np.testing.assert_allclose(vertices.min(axis=0)[:2], [9.05, 19.55], atol=1e-6)
    np.testing.assert_allclose(vertices.max(axis=0)[:2], [10.95, 20.25], atol=1e-6)
    np.testing.assert_allclose(vertices[:, 2], 2 + 0.5 * (vertices[:, 0] - 10), atol=0.02)
    a, b, c = vertices[triangles].transpose(1, 0, 2)
    assert (np.cross(b - a, c - a)[:, 2] > 0).all()


def test_mesh_leaves_holes_open():
    heights = np.zeros((3, 3))
    heights[0, 0] = np.nan
    vertices, triangles = triangulate(heights, np.zeros(3), 1.0)
    assert vertices.tolist()[0] == [-1, 0, 0] and len(vertices) == 8
    assert len(triangles) == 6 and set(triangles.ravel()) == set(range(8))


def test_mesh_of_an_empty_map(tmp_path, emap):
    assert save_mesh(tmp_path / "empty.ply", emap, env=0) == 0
    assert plyfile.PlyData.read(tmp_path / "empty.ply")["vertex"].count == 0


def test_points_are_the_known_cells(tmp_path, emap):
    points = to_points(emap, env=1)
    known = emap.validity[1]
    expected = torch.cat([emap.cell_centers()[1][known], emap.elevation[1][known][:, None].double()], -1)
    np.testing.assert_allclose(points, expected, rtol=0, atol=1e-9)
    assert points.dtype == np.float64 and len(points) == 20 * 8
    assert save_cloud(tmp_path / "cloud.ply", emap, env=1) == len(points)
    data = plyfile.PlyData.read(tmp_path / "cloud.ply")
    assert [element.name for element in data.elements] == ["vertex"]
    np.testing.assert_array_equal(np.stack([data["vertex"][axis] for axis in "xyz"], -1), points)


def test_points_and_mesh_of_another_layer_share_its_known_cells(emap):
    vertices, triangles = to_mesh(emap, env=1, layer="validity")
    assert len(vertices) == 20 * 10 and len(triangles) == 2 * 19 * 9 and set(vertices[:, 2]) == {0.0, 1.0}
    np.testing.assert_array_equal(to_points(emap, env=1, layer="validity"), vertices)


def test_a_cloud_of_an_empty_map(tmp_path, emap):
    assert to_points(emap, env=0).shape == (0, 3)
    assert save_cloud(tmp_path / "empty.ply", emap) == 0


def test_takes_the_layers_that_are_asked_for(emap):
    assert list(take(emap, layers=("variance", "time")).layers) == ["variance", "time"]
    with pytest.raises(KeyError, match="height"):
        take(emap, layers=("height",))
    for env in (2, -1):
        with pytest.raises(ValueError, match=rf"env: must lie in \[0, 2\), got {env}"):
            take(emap, env=env)


def test_takes_bfloat16_as_float32(emap):
    heights = take(emap.to(torch.bfloat16), env=1).layers["elevation"]
    assert heights.dtype == np.float32
    np.testing.assert_array_equal(heights, emap.layer("elevation")[1].float().numpy())


def test_refuses_what_is_no_npz(tmp_path):
    (tmp_path / "map.npz").write_text("elevation")
    with pytest.raises(ValueError, match=r"map\.npz: must be an \.npz file, got another format"):
        load_npz(tmp_path / "map.npz")


@register
def seven_everywhere(layer):
    return torch.full_like(layer[0], 7.0), torch.ones_like(layer[1])


def with_filter(name):
    """A map with one filter, which makes a layer of this name."""
    step = FilterConfig(layer=name, filter="seven_everywhere")
    return ElevationMap(dataclasses.replace(small_config(), filters=(step,)))


def test_layers_of_filters_are_saved_too(tmp_path):
    save_npz(tmp_path / "map.npz", with_filter("more"))
    saved = load_npz(tmp_path / "map.npz")
    assert list(saved.layers)[-1] == "more" and (saved.layers["more"] == 7).all()


def test_refuses_a_layer_named_as_a_fact(tmp_path):
    with pytest.raises(
        ValueError,
        match="layers: must not be named resolution, center, axes, config, file, or begin with map_, got center",
    ):
        save_npz(tmp_path / "map.npz", with_filter("center"))
