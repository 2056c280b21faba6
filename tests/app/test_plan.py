"""`torchelev plan`, end to end."""

import math

import pytest
import torch
from click.testing import CliRunner

from torchelev import ChannelConfig, ElevationMap, ElevationMapConfig, GridConfig, TraversabilityConfig
from torchelev.app.cli import main
from torchelev.channels.state import Channel
from torchelev.io.export import save_map, save_npz, take, write_npz
from torchelev.pipeline import rate

GRID = GridConfig(resolution=0.1, length_x=4.0, length_y=3.0)


def world(height=0.3, gap=2.0, **stages):
    """Ground with a step at x = 0, of height 0 for y > gap."""
    emap = ElevationMap(ElevationMapConfig(grid=GRID, **stages))
    x, y = emap.cell_centers().unbind(-1)
    emap.elevation.copy_(torch.where((x > 0) & (x < 0.2) & (y < gap), height, 0.0))
    emap.validity.fill_(True)
    emap.variance.fill_(1e-4)
    emap.load_state(rate(emap.state, emap.cfg))
    return emap


def run(*arguments):
    result = CliRunner().invoke(main, ["plan", *map(str, arguments)])
    return result.exit_code, result.output if result.exit_code >= 2 else result.stdout


ENDS = ("--start", -1.0, 0.05, "--goal", 1.0, 0.05)


@pytest.mark.slow(1)
@pytest.mark.parametrize("save", [save_npz, save_map])
def test_a_path_around_a_wall(tmp_path, save):
    save(tmp_path / "map.npz", world(gap=0.5))
    code, text = run(tmp_path / "map.npz", *ENDS, "--out", tmp_path / "path.png")
    assert code == 0 and text.startswith("path") and "every footprint along the path is safe" in text
    assert float(text.split(" m, ")[0].split()[-1]) > 2.3, "longer than the straight line"
    assert (tmp_path / "path.png").read_bytes().startswith(b"\x89PNG")


@pytest.mark.slow(1)
@pytest.mark.parametrize("robot", [(), ("--step-height", 0.2)])
def test_a_path_around_a_class_that_is_forbidden(tmp_path, robot):
    """Flat ground with water at x = 0 up to y = 0.5; a robot of its own keeps the map's channels."""
    channels = {"semantic": ChannelConfig(kind="class", names=("grass", "water"))}
    emap = world(height=0.0, channels=channels)
    x, y = emap.cell_centers()[0].unbind(-1)
    is_water = ((x > -0.2) & (x < 0.2) & (y < 0.5)).float()
    emap.channels.write(
        "semantic", Channel(torch.stack([1 - is_water, is_water], -1)[None] * 20, 20 * torch.ones(1, 40, 30), None)
    )
    save_map(tmp_path / "map.npz", emap)
    lengths = []
    for costs in ((), ("--class-cost", "semantic.water=inf")):
        code, text = run(tmp_path / "map.npz", *ENDS, *robot, *costs)
        assert code == 0 and text.startswith("path")
        lengths.append(float(text.split(" m, ")[0].split()[-1]))
    assert lengths[0] == pytest.approx(2.0, abs=0.05) and lengths[1] > 2.3


@pytest.mark.slow(1)
def test_a_path_on_which_the_body_does_not_fit_is_marked(tmp_path, figures):
    """A body of 1.2 m beside a gap of 0.7 m: its centre passes where its front, which turns, hits the wall."""
    emap = world(gap=2.0)
    y = emap.cell_centers()[..., 1]
    emap.elevation.masked_fill_((y - 0.5).abs() < 0.35, 0.0)
    emap.load_state(rate(emap.state, emap.cfg))
    save_npz(tmp_path / "map.npz", emap)
    code, text = run(tmp_path / "map.npz", *ENDS, "--width", 0.2, "--length", 1.2, "--out", tmp_path / "path.png")
    assert code == 1 and text.startswith("not safe") and "cannot be reached safely" in text
    x, y = text.split("at x = ")[1].split(" m ")[0].split(" m, y = ")
    for axes in figures[0].axes[:2]:
        (marked,) = [line for line in axes.lines if line.get_label().startswith("not safe")]
        assert marked.get_xydata()[0].tolist() == pytest.approx([float(x), float(y)], abs=0.006)
        (refused,) = [line for line in axes.lines if line.get_linestyle() == "--"]
        assert refused.get_color() == "r" and refused.get_xydata()[-1].tolist() == pytest.approx([1.05, 0.05])
        assert axes.get_legend() is not None


def test_no_path_says_why(tmp_path):
    save_npz(tmp_path / "map.npz", world())
    code, text = run(tmp_path / "map.npz", *ENDS)
    assert code == 1 and text.startswith("no path") and "steps are higher than the robot can overcome" in text


def test_options_are_the_robots_limits(tmp_path):
    save_npz(tmp_path / "map.npz", world(0.15, traversability=TraversabilityConfig(critical_step=0.1)))
    assert run(tmp_path / "map.npz", *ENDS)[0] == 1
    assert run(tmp_path / "map.npz", *ENDS, "--step-height", 0.16)[0] == 0
    assert run(tmp_path / "map.npz", *ENDS, "--step-height", 0.12)[0] == 1


def test_a_map_without_a_head_is_rated_for_the_default_robot(tmp_path):
    save_npz(tmp_path / "map.npz", world(0.1, traversability=None))
    assert run(tmp_path / "map.npz", *ENDS)[0] == 0


@pytest.mark.parametrize("arguments, text", [
    (("map.npz", "--goal", 9, 0), "goal_xy: must lie in the window"),
    (("map.npz", "--goal", math.nan, 0), "goal_xy: must lie in the window"),
    (("map.npz", "--goal", 1, 0, "--max-slope", 35), "robot.max_slope: must be below a right angle"),
    (("none.npz", "--goal", 1, 0), "none.npz: no such file or directory\n"),
    (("none.npz", "--goal", 1, 0, "--out", "path.xyz"), "out: must be a picture, got one of suffix .xyz"),
    (("layers.npz", "--goal", 1, 0), "must be a whole map"),
    (("empty.npz", "--goal", 1, 0), "the map is empty"),
    (("map.npz",), "Missing option '--goal'"),
    (("map.npz", "--goal", 1, 0, "--class-cost", "water=inf"), "CHANNEL.CLASS=FACTOR, got 'water=inf'"),
    (("map.npz", "--goal", 1, 0, "--class-cost", "semantic.water=much"), "must be CHANNEL.CLASS=FACTOR"),
    (("map.npz", "--goal", 1, 0, "--class-cost", "semantic.water=3"), "cost.class_costs"),
])  # fmt: skip
def test_bad_input_is_one_line(tmp_path, arguments, text):
    emap = world()
    save_npz(tmp_path / "map.npz", emap)
    write_npz(tmp_path / "layers.npz", take(emap))
    save_npz(tmp_path / "empty.npz", ElevationMap(emap.cfg))
    code, output = run(tmp_path / arguments[0], *arguments[1:])
    assert code == (3 if arguments[0] == "empty.npz" else 2) and text in output and "Traceback" not in output
