"""Where values lie: the points of scans and images, and layouts that do not fit a group."""

import pytest
import torch

from tests.helpers import mapped, pose
from torchelev import ElevationMap, ElevationMapConfig, GridConfig, HeightScan, MapImage
from torchelev.encoders import AttentionConfig, MapLayout
from torchelev.encoders.layout import describe_points


def find(shape, others=None, **settings):
    return MapLayout.find("map", AttentionConfig(**settings), {"map": shape} | (others or {}))


@pytest.mark.parametrize("name, grid", [("isaac_lab", (11, 17)), ("mjlab", (11, 17)), ("legged_gym", (17, 11))])
def test_points_of_a_preset(name, grid):
    pattern = torch.tensor(HeightScan.preset(name).pattern)
    for points in (name, HeightScan.preset(name), HeightScan.preset(name).pattern, pattern.tolist(), pattern):
        layout = find((187,), points=points, grid=grid)
        assert layout.groups == ("map",) and layout.channels == 1 and layout.validity is None
        assert torch.equal(layout.coordinates, pattern.T.unflatten(-1, grid))
    assert find((187,), points=name).coordinates.shape == (2, 1, 187)
    with pytest.raises(ValueError, match="grid: must number the points row by row, in equal steps"):
        find((187,), points=name, grid=grid[::-1])


def test_points_around_feet_tell_which_foot_it_is():
    rows = describe_points(HeightScan.feet(num_feet=3))
    one, feet = describe_points(HeightScan.feet(num_feet=1).pattern), rows[:, 2:].unflatten(0, (3, -1))
    assert torch.equal(rows[:, :2], one.repeat(3, 1))
    for k, foot in enumerate(torch.eye(3)):
        assert torch.equal(feet[k], foot.expand(52, 3))


def test_pixels_lie_where_a_map_image_reads_them():
    image = MapImage(length_x=1.2, length_y=0.8, resolution=0.2, offset=(0.3, -0.1))
    layout = find(image.shape, resolution=0.2, offset=(0.3, -0.1), validity=1)
    assert layout.channels == 4 and layout.validity == 1
    expected = image.xy(pose())[0].T.float().unflatten(-1, image.shape[1:])
    torch.testing.assert_close(layout.coordinates, expected)
    assert torch.equal(find(image.shape, points=expected.flatten(1).T).coordinates, expected)


def test_values_and_validity_of_a_scan_are_one_group_or_two():
    emap = mapped()
    values, valid = HeightScan.grid(length_x=0.4, length_y=0.2)(emap, pose(num_envs=2))
    settings = {"points": HeightScan.grid(length_x=0.4, length_y=0.2)}
    stacked = find(torch.stack([values, valid], 1).shape[1:], **settings, validity=1)
    assert (stacked.groups, stacked.channels, stacked.validity) == (("map",), 2, 1)
    two = find(values.shape[1:], {"known": valid.shape[1:]}, **settings, validity="known")
    assert (two.groups, two.channels, two.validity) == (("map", "known"), 2, 1)


def test_a_scan_with_channels_is_one_group_of_as_many_rows():
    scan = HeightScan.grid(length_x=0.4, length_y=0.2, channels=("rgb", "heat"))
    cfg = ElevationMapConfig(
        grid=GridConfig(resolution=0.1, length_x=2, length_y=2), channels=dict(rgb="color", heat="mean")
    )
    values, valid = scan(ElevationMap(cfg), pose())
    assert values.shape[1:] == scan.shape_on(cfg) == (5, 15)
    layout = find(torch.cat([values, valid], 1).shape[1:], points=scan, validity=5)
    assert (layout.channels, layout.validity, layout.coordinates.shape) == (10, 5, (2, 1, 15))


@pytest.mark.parametrize(
    "shape, settings, named",
    [
        ((186,), {"points": "isaac_lab"}, r"points: expected 186, one for each value of the group, got 187"),
        ((2, 154), {"points": "isaac_lab"}, r"points: expected 154, .*, got 187; give the pattern"),
        ((187,), {}, "points: must be given for a scan"),
        ((187,), {"points": "isaac"}, "preset: must be one of isaac_lab, mjlab, legged_gym"),
        ((3,), {"points": [1.0, 2.0, 3.0]}, "points: must be .* finite numbers.*, got list"),
        ((2,), {"points": [[0.0], [1.0]]}, r"points: must be .* finite numbers.*, got \(2, 1\)"),
        ((2,), {"points": [[0.0, 1.0], [1.0]]}, "points: must be .* finite numbers.*, got list"),
        ((1,), {"points": [[0.0, float("nan")]]}, "points: must be .* finite numbers"),
        ((187,), {"points": "isaac_lab", "kernel_size": 3}, "grid: must be given for a convolution"),
        (
            (187,),
            {"points": "isaac_lab", "grid": (10, 17)},
            r"grid: must be rows x columns of 187 points, got \(10, 17",
        ),
        ((187,), {"points": "isaac_lab", "grid": (11, 17), "patch": 2}, "patch: must divide the 11 x 17 points, got 2"),
        ((187,), {"points": "isaac_lab", "validity": 1}, "validity: must be one of the group's 1 channels, got 1"),
        ((187,), {"points": "isaac_lab", "validity": "known"}, "validity: must be one of the groups map, body, got 'k"),
        ((187,), {"points": "isaac_lab", "validity": "body"}, "validity: must have 187 values, one a point, got 12"),
        ((4, 8, 8), {}, "resolution: or else points must be given for an image"),
        ((4, 8, 8), {"resolution": 0.1, "points": "isaac_lab"}, "resolution: or else points must be given"),
        ((4, 8, 8), {"points": "isaac_lab"}, "points: expected 64, one for each value of the group, got 187"),
        ((4, 8, 8), {"resolution": 0.1, "grid": (8, 8)}, "grid: must be None for an image"),
        ((), {"points": "isaac_lab"}, r"map: must be a group \(B, P\), \(B, C, P\) or \(B, C, H, W\)"),
    ],
)
def test_refuses_by_name(shape, settings, named):
    with pytest.raises(ValueError, match=f"^{named}"):
        find(shape, {"body": (12,)}, **settings)
