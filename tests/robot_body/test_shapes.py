"""Shapes of a robot: what they refuse, the order of links, and the way to plain dicts, YAML and back."""

import numpy as np
import pytest
import yaml

from tests.helpers import mapped, small_config
from tests.robot_body.bodies import random_body
from torchelev import Box, Capsule, ElevationMapConfig, RobotBody, SensorConfig

LEG = dict(link="shank", start=(0.0, 0.0, 0.0), end=(0.0, 0.0, -0.2), radius=0.02)
TRUNK = dict(link="base", center=(0.0, 0.0, 0.0), half_lengths=(0.2, 0.1, 0.05))


def test_links_are_named_once_in_the_order_of_the_shapes():
    foot = Capsule(link="foot", start=(0.0, 0.0, 0.0), end=(0.0, 0.0, 0.0), radius=0.02)
    body = RobotBody(boxes=(Box(**TRUNK), Box(**TRUNK)), capsules=(Capsule(**LEG), foot, Capsule(**LEG)))
    assert body.links == ("shank", "foot", "base") == SensorConfig(body=body).links
    assert SensorConfig().links == ()
    assert (Capsule(**LEG).length, foot.length) == (pytest.approx(0.2), 0.0)


def test_lists_and_arrays_become_tuples_of_floats():
    leg = Capsule(link="a", start=np.zeros(3, np.float32), end=[0, 0, 1], radius=0.1)
    assert leg == Capsule(link="a", start=(0.0, 0.0, 0.0), end=(0.0, 0.0, 1.0), radius=0.1)
    body = RobotBody(capsules=[leg])
    assert body == RobotBody(capsules=(leg,)) and hash(body) == hash(RobotBody(capsules=(leg,)))


@pytest.mark.parametrize(
    "make, error, text",
    [
        (lambda: Capsule(**LEG | dict(link="")), ValueError, r"capsule\.link: must be the name of a link, got ''"),
        (lambda: Capsule(**LEG | dict(link=3)), ValueError, r"capsule\.link: .*got 3"),
        (lambda: Capsule(**LEG | dict(radius=0.0)), ValueError, r"capsule\.radius: must be a positive number"),
        (lambda: Capsule(**LEG | dict(radius=float("nan"))), ValueError, r"capsule\.radius"),
        (lambda: Capsule(**LEG | dict(start=(0.0, 0.0))), ValueError, r"capsule\.start: must be 3 finite numbers"),
        (lambda: Capsule(**LEG | dict(end=0.2)), ValueError, r"capsule\.end: must be 3 finite numbers, got 0\.2"),
        (lambda: Capsule(**LEG | dict(end=("0", 0, 0))), ValueError, r"capsule\.end"),
        (lambda: Capsule(**LEG | dict(end=(0, 0, float("inf")))), ValueError, r"capsule\.end"),
        (lambda: Box(**TRUNK | dict(half_lengths=(0.1, 0.0, 0.1))), ValueError, r"box\.half_lengths: must be positive"),
        (lambda: Box(**TRUNK | dict(center="abc")), ValueError, r"box\.center: must be 3 finite numbers, got 'abc'"),
        (lambda: Box(**TRUNK, quat_wxyz=(2.0, 0, 0, 0)), ValueError, r"box\.quat_wxyz: must have norm 1, got 2"),
        (lambda: Box(**TRUNK, quat_wxyz=(1.0, 0)), ValueError, r"box\.quat_wxyz: must be 4 .*; give w, x, y, z$"),
        (lambda: Box(**TRUNK | dict(center=(1.0,))), ValueError, r"box\.center: must be 3 finite .*; give metres$"),
        (lambda: RobotBody(), ValueError, "body: must have a capsule or a box"),
        (lambda: RobotBody(capsules=(Box(**TRUNK),)), TypeError, r"body\.capsules: must be a tuple .*Capsule"),
        (lambda: RobotBody(capsules=Capsule(**LEG)), TypeError, r"body\.capsules"),
        (lambda: RobotBody(boxes=(TRUNK,)), TypeError, r"body\.boxes"),
        (lambda: RobotBody(boxes=(Box(**TRUNK),), padding=-0.1), ValueError, r"body\.padding: .*not negative"),
        (lambda: RobotBody(boxes=(Box(**TRUNK),), depth_tolerance=None), ValueError, r"body\.depth_tolerance"),
        (
            lambda: SensorConfig(body=Box(**TRUNK)),
            TypeError,
            r"sensor\.body: must be a BodyConfig, a RobotBody",
        ),
        (lambda: SensorConfig(body=True), TypeError, r"sensor\.body"),
    ],
)
def test_refuses(make, error, text):
    with pytest.raises(error, match=text):
        make()


@pytest.mark.parametrize("seed", range(3))
def test_dicts_yaml_and_back(seed):
    body = random_body(np.random.default_rng(seed), capsules=seed, padding=0.01)
    cfg = ElevationMapConfig(sensor=SensorConfig(body=body))
    plain = yaml.safe_load(yaml.safe_dump(cfg.to_dict()))
    for values in (cfg.to_dict(), plain):
        again = ElevationMapConfig.from_dict(values)
        assert again == cfg and hash(again) == hash(cfg)


@pytest.mark.parametrize(
    "body, text",
    [
        (dict(capsules=[LEG | dict(diameter=0.1)]), r"config\.sensor\.body\.capsules\[0\]\.diameter: is not a setting"),
        (dict(boxes=[TRUNK, 3]), r"config\.sensor\.body\.boxes\[1\]: must be a mapping, got int"),
        (dict(capsules=[LEG], pading=0.1), r"config\.sensor\.body\.pading: is not a setting"),
        (dict(capsules=[LEG | dict(radius="2 cm")]), r"capsules\[0\]\.radius: must be a number"),
        (dict(capsules=LEG), r"config\.sensor\.body\.capsules: must be a list, got dict"),
    ],
)
def test_bad_dicts_are_refused_by_name(body, text):
    with pytest.raises(ValueError, match=text):
        ElevationMapConfig.from_dict({"sensor": {"body": body}})


def test_a_checkpoint_tells_which_setting_differs():
    body = random_body(np.random.default_rng(0))
    emap = mapped(sensor=SensorConfig())
    other = type(emap)(small_config(sensor=SensorConfig(body=body)), 2)
    with pytest.raises(ValueError, match="state_dict: .*other sensor.body"):
        other.load_state_dict(emap.state_dict())
    other.load_state_dict(type(emap)(small_config(sensor=SensorConfig(body=body)), 2).state_dict())
