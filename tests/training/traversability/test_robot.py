"""A robot as a command-line option."""

import functools

import click
import pytest

from torchelev.robot import RobotConfig
from training.traversability.robot import RobotType


def test_a_robot_comes_as_pairs_or_as_a_file(tmp_path):
    convert = functools.partial(RobotType().convert, param=None, ctx=None)
    assert convert("length=0.5, width=0.3") == RobotConfig(length=0.5, width=0.3)
    (tmp_path / "robot.yaml").write_text("length: 0.9\nclearance: 0.4\n")
    assert convert(str(tmp_path / "robot.yaml")) == RobotConfig(length=0.9, clearance=0.4)
    (tmp_path / "list.yaml").write_text("[1, 2]\n")
    wrong = {
        "legs=4": "there is no legs; there are length, width",
        "length=long": "length must be a number",
        "length": "length must be a number",
        "length=0.3": "must not exceed the length",
        "length=-1,width=-2": "must be a positive number",
        str(tmp_path / "none.yaml"): "No such file",
        str(tmp_path / "list.yaml"): "must hold a mapping",
    }
    for text, message in wrong.items():
        with pytest.raises(click.BadParameter, match=message):
            convert(text)
