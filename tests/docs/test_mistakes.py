"""The troubleshooting page: what it says of each mistake is what the map says, and each has its picture."""

import re

import pytest
import torch

from docs.mistakes.__main__ import PICTURES
from docs.mistakes.cases import CASES, misread, quaternion, right_map, wrong_map
from docs.mistakes.pictures import draw
from docs.mistakes.walk import DT
from torchelev.frames import transform

PAGE = (PICTURES.parent / "troubleshooting.md").read_text()
TEXT = re.sub(r"\s+", " ", PAGE.replace("*", ""))

QUOTED = {
    "millimetres": "millimetres: check units, and multiply them by 0.001",
    "optical": "the points have optical axes",
    "no-base": "give T_map_base, which the window follows",
    "opengl": "the sensor is mounted upside down",
    "quaternion": "a quaternion in the order x y z w was read as w x y z",
    "base-quaternion": "the base's quaternion, in the order x y z w, was read as w x y z",
    "inverted": "T_map_sensor is inverted",
    "map-frame": "the pose is applied twice",
    "late": "poses lag behind a robot that sways",
    "legs": "stay within 0.4 m of the robot while it moves",
}
COUNTED = {
    "millimetres": "rejected_range",
    "optical": "rejected_overhang",
    "no-base": "rejected_outside",
    "low-base": "cleared_other_floors",
    "floors": "cleared_other_floors",
    "late": "rejected_outlier",
}
SILENT = ("pitch",)


@pytest.fixture(scope="module", params=sorted(QUOTED | COUNTED | dict.fromkeys(SILENT)))
def case(request):
    """The name of a case, and its map with the mistake."""
    return request.param, wrong_map(CASES[request.param])


@pytest.mark.slow(12)
def test_the_page_says_what_the_map_says(case):
    name, wrong = case
    sentences = wrong.diagnose()
    if name in QUOTED:
        assert QUOTED[name] in sentences[0]
        assert QUOTED[name].lower() in TEXT.lower()
    assert name not in SILENT or sentences == []
    if name in COUNTED:
        count, usual = (getattr(emap.statistics, COUNTED[name]).item() for emap in (wrong, right_map(CASES[name])))
        assert count > 2 * usual and count > 100
        assert COUNTED[name] in PAGE


def test_every_mistake_has_its_picture_on_the_page():
    shown = re.findall(r"\(pictures/mistake-(.*?)\.png\)", PAGE)
    assert sorted(shown) == sorted(CASES)
    assert {path.name for path in PICTURES.glob("mistake-*.png")} == {f"mistake-{name}.png" for name in CASES}


@pytest.mark.slow(2)
def test_a_picture_has_both_maps_side_by_side():
    case = CASES["axes"]
    emap = right_map(case)
    left, right = (ax.images[0] for ax in draw(case, emap, emap).axes[:2])
    known = torch.isfinite(emap.layer("elevation")[0])
    assert ((~left.get_array().mask).T == known.numpy()).all() and (right.get_array().mask == ~known.numpy()).all()
    assert left.get_clim() == right.get_clim() and emap.state.time.max() > DT


def test_a_quaternion_of_a_pose_is_that_of_which_it_was_made():
    quat = torch.nn.functional.normalize(torch.tensor([[0.8, 0.1, -0.5, 0.3]]).double(), dim=-1)
    pose = transform(torch.ones(1, 3).double(), quat)
    torch.testing.assert_close(quaternion(pose), quat)
    expected = transform(torch.ones(1, 3).double(), quat.roll(-1, -1))
    torch.testing.assert_close(misread(pose), expected)
