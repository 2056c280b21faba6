"""The benchmark of the self-filter: a robot whose feet stand on the ground, and figures that follow what is removed."""

import json

import pytest
import torch
from click.testing import CliRunner

from benchmarks.self_filter import __main__ as command
from benchmarks.self_filter import legs, speed
from benchmarks.self_filter.robot import FOOT_RADIUS, HEIGHT, STRIDE, link_poses, make_body, make_cameras, walk


def feet(phase):
    """Positions (B, 4, 3) of the feet's middles in the base frame."""
    body = make_body()
    T = dict(zip(body.links, link_poses(phase, body.links).unbind(1), strict=True))
    balls = [capsule for capsule in body.capsules if not capsule.length]
    return torch.stack([(T[ball.link] @ torch.tensor([*ball.start, 1.0]).double())[:, :3] for ball in balls], 1)


def test_two_feet_stand_while_the_others_swing():
    phase = torch.linspace(0, 1, 41, dtype=torch.float64)[:-1]
    at = feet(phase)
    stands = (at[..., 2] + HEIGHT).abs() < 1e-6
    assert (stands.sum(1) >= 2).all() and torch.equal(stands[:, 0], stands[:, 3])
    assert at[..., 2].max() > 0.05 - HEIGHT
    reach = at[:, 0, 0] - at[:, 0, 0].mean()
    assert reach.amax() - reach.amin() == pytest.approx(STRIDE, abs=1e-6)


def test_links_of_a_leg_meet():
    """The thigh's end is where the shank begins."""
    body, phase = make_body(), torch.rand(5, generator=torch.Generator().manual_seed(0))
    T = dict(zip(body.links, link_poses(phase, body.links).unbind(1), strict=True))
    thigh = next(capsule for capsule in body.capsules if capsule.link == "rear_left_thigh")
    end = (T["rear_left_thigh"] @ torch.tensor([*thigh.end, 1.0]).double())[:, :3]
    torch.testing.assert_close(end, T["rear_left_shank"][:, :3, 3])
    assert len(body.links) == 13 and len(body.capsules) + len(body.boxes) == 17


def test_cameras_see_legs_and_ground():
    scans = walk(3, 2, make_cameras())
    scan = scans[1]
    assert scan.points.shape == (3, 2, 300, 3) and 0.03 < scan.on_body.double().mean() < 0.5
    ground = scan.points.double() @ scan.T_map_sensor[..., :3, :3].mT + scan.T_map_sensor[..., None, :3, 3]
    assert ground[..., 2][scan.points.isfinite().all(-1) & ~scan.on_body].abs().max() < 1e-4
    moved = scan.T_map_base[:, 0, 3] - scans[0].T_map_base[:, 0, 3]
    assert (moved - 0.1 * 2 * STRIDE / 0.5).abs().max() < 1e-9 and FOOT_RADIUS > 0


@pytest.mark.slow(3)
def test_padding_takes_ground_and_noise_leaves_legs():
    result = legs.measure(robots=4, width=40, height=30)
    rows = result["rows"]
    assert result["on_body"] > 500 and result["near_feet"] > 50
    assert rows["0 mm, 0 mm"] == {"left": 0.0, "lost": 0.0}
    assert rows["10 mm, 0 mm"]["lost"] > rows["3 mm, 0 mm"]["lost"] and rows["0 mm, 6 mm"]["left"] > 0


@pytest.mark.slow(4)
def test_the_command_writes_what_it_measured(tmp_path):
    small = dict(speed=lambda seconds: speed.measure(seconds, 2, False, 2), legs=lambda _: legs.measure(1, 10, 8))
    for only in ("speed", "legs"):
        options = ["--seconds", "0", "--only", only, "--out", str(tmp_path)]
        outcome = CliRunner().invoke(command.main, options, obj=small)
        assert outcome.exit_code == 0, outcome.output
    result = json.loads((tmp_path / "self_filter.json").read_text())
    assert set(result) == {"machine", "speed", "legs"} and result["speed"]["points"] == 600
    assert "17 shapes of 13 links" in outcome.output and "3 mm, 6 mm" in outcome.output
