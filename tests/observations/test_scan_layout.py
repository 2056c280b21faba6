"""The layout of a scan that is stored with a policy."""

import dataclasses
import json

import pytest

from torchelev import HeightScan
from torchelev.observations.scan_layout import require_layout, scan_layout

SCANS = [
    HeightScan.isaac_lab(),
    HeightScan.mjlab(),
    HeightScan.legged_gym(),
    HeightScan.feet(),
    HeightScan.grid(fill="lowest"),
    HeightScan.grid(fill="lowest", channels=("rgb", "terrain.stone")),
]


@pytest.mark.parametrize("scan", SCANS)
def test_a_layout_survives_json_and_fits_its_own_scan(scan):
    require_layout(scan, json.loads(json.dumps(scan_layout(scan), allow_nan=False)))


@pytest.mark.parametrize("first", range(6))
@pytest.mark.parametrize("second", range(6))
def test_every_other_preset_is_refused(first, second):
    if first != second:
        with pytest.raises(ValueError, match="height_scan"):
            require_layout(SCANS[first], scan_layout(SCANS[second]))


@pytest.mark.parametrize(
    ("setting", "value"),
    [("scale", 5.0), ("clip", 2.0), ("nominal_height", 0.3), ("fill", "base"), ("mode", "nearest"),
     ("standing_height", 0.4), ("alignment", "base"), ("inpaint_rings", 2)],
)  # fmt: skip
def test_a_setting_that_differs_is_named_with_both_values(setting, value):
    trained = HeightScan.isaac_lab()
    other = dataclasses.replace(trained, **{setting: value})
    with pytest.raises(ValueError, match=rf"height_scan.{setting}: must be .*build the scan with {setting}="):
        require_layout(other, scan_layout(trained))


def test_channels_are_named_only_where_they_are_read():
    """A policy that reads heights alone keeps its layout of before there were channels."""
    assert not {"channels", "channel_fill"} & scan_layout(SCANS[0]).keys()
    for setting, value in (("channels", ("rgb",)), ("channel_fill", -1.0)):
        other = dataclasses.replace(SCANS[5], **{setting: value})
        with pytest.raises(ValueError, match=rf"height_scan.{setting}: must be .*build the scan with {setting}="):
            require_layout(other, json.loads(json.dumps(scan_layout(SCANS[5]))))
    with pytest.raises(ValueError, match="height_scan.channel_fill"):
        require_layout(SCANS[4], scan_layout(SCANS[5]))


def test_noise_and_reach_do_not_matter():
    scan = HeightScan.feet(noise=0.1)
    require_layout(dataclasses.replace(scan, noise=0.0, reach=0.4), scan_layout(scan))


def test_order_and_spacing_are_told_apart():
    with pytest.raises(ValueError, match="the same points in another order"):
        order = HeightScan.grid(nominal_height=0.5, clip=1.0, original=-1.0)
        require_layout(order, scan_layout(HeightScan.isaac_lab()))
    with pytest.raises(ValueError, match=r"foot.pattern: .*got 693 points over x -0.8 to 0.8 m"):
        require_layout(HeightScan.isaac_lab(resolution=0.05), scan_layout(HeightScan.isaac_lab()), "foot")
