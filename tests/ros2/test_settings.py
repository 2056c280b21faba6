"""The node's parameters: from files, of their types, and refused by name."""

import dataclasses
from pathlib import Path

import pytest
from click.testing import CliRunner

from torchelev.app.ros2_command import ros2_command
from torchelev.ros2.outputs import SERVICES, TOPICS
from torchelev.ros2.settings import NodeSettings, list_changeable, make_settings, nest, read_node_file, split

FILE = """
map_frame: map
clouds: [/front, /rear]
rate_costmap: 5
map:
  grid: {resolution: 0.05, length_x: 8.0, length_y: 8.0}
  drift: null
"""


def test_a_file_has_the_nodes_parameters_and_the_maps_settings(tmp_path):
    (tmp_path / "robot.yaml").write_text(FILE)
    settings, cfg = read_node_file(tmp_path / "robot.yaml")
    assert settings == NodeSettings(map_frame="map", clouds=("/front", "/rear"), rate_costmap=5.0)
    assert cfg == {"grid": {"resolution": 0.05, "length_x": 8.0, "length_y": 8.0}, "drift": None}


@pytest.mark.parametrize("names", [["/**", "ros__parameters"], ["elevation_mapping", "ros__parameters"]])
def test_a_file_of_ros_is_read_too(tmp_path, names):
    text = FILE
    for name in reversed(names):
        text = f"{name}:\n" + "\n".join(f"  {line}" for line in text.splitlines())
    (tmp_path / "robot.yaml").write_text(text)
    (tmp_path / "plain.yaml").write_text(FILE)
    assert read_node_file(tmp_path / "robot.yaml") == read_node_file(tmp_path / "plain.yaml")


def test_an_empty_file_is_all_defaults(tmp_path):
    (tmp_path / "robot.yaml").write_text("")
    assert read_node_file(tmp_path / "robot.yaml") == (NodeSettings(), {})


@pytest.mark.parametrize(
    "values, words",
    [
        ({"map_fram": "odom"}, "map_fram: is no parameter, got 'map_fram'; there are map, map_frame"),
        ({"clouds": "/points"}, "clouds: must be a list of names, got '/points'"),
        ({"clouds": []}, "clouds: must not be empty"),
        ({"rate_map": "2"}, "rate_map: must be a number, got '2'; such as 2.0"),
        ({"rate_map": -1.0}, "rate_map: must lie in .0, 1000., got -1.0"),
        ({"rate_map": 1e9}, "rate_map: must lie in .0, 1000., got 1000000000.0"),
        ({"transform_wait": -1.0}, "transform_wait: must lie in .0, 1000., got -1.0; give seconds"),
        ({"clouds": ["a"], "depths": ["a"]}, "clouds, depths: must not repeat a topic, got a, a"),
        ({"feet": [""]}, "feet: must not have an empty name"),
        ({"map_file": ""}, "map_file: must not be empty"),
        ({"rate_map": True}, "rate_map: must be a number, got True"),
        ({"threads": 1.5}, "threads: must be a whole number, got 1.5"),
        ({"threads": 0}, "threads: must be at least 1, got 0"),
        ({"min_traversability": 1.0}, r"min_traversability: must lie in \[0, 1\), got 1.0"),
        ({"robot_height": -0.5}, r"robot_height: must lie in \[0, 20\] m, got -0.5"),
        ({"engine": "cuda"}, "engine: must be one of auto, torch, library, got 'cuda'"),
    ],
)
def test_wrong_parameters_are_refused_by_name(tmp_path, values, words):
    with pytest.raises(ValueError, match=words):
        make_settings(values)


def test_errors_name_the_file(tmp_path):
    (tmp_path / "robot.yaml").write_text("thread: 2\nmap: {}\n")
    with pytest.raises(ValueError, match=r"robot.yaml: thread: is no parameter"):
        read_node_file(tmp_path / "robot.yaml")


def test_ros_has_names_with_points_and_parameters_of_its_own(tmp_path):
    given = {"map.grid.resolution": 0.05, "map.drift.gain": 0.5, "rate_map": 1.0, "use_sim_time": True}
    assert split(nest(given)) == (
        {"rate_map": 1.0},
        {"grid": {"resolution": 0.05}, "drift": {"gain": 0.5}},
    )


def test_one_group_alone_is_no_file_of_ros(tmp_path):
    (tmp_path / "robot.yaml").write_text("grid: {resolution: 0.05}\n")
    with pytest.raises(ValueError, match="grid: is no parameter"):
        read_node_file(tmp_path / "robot.yaml")


@pytest.mark.parametrize("arguments", [["robot.yaml"], ["--cofnig", "robot.yaml"]])
def test_what_is_not_for_ros_is_refused(arguments):
    found = CliRunner().invoke(ros2_command, arguments)
    assert found.exit_code == 2 and "what is for ROS follows --ros-args" in found.output


def test_what_may_change_while_it_runs():
    assert {"rate_map", "layers", "min_traversability", "map_file"} <= list_changeable()
    assert not {"clouds", "map_frame", "engine", "threads"} & list_changeable()


def test_the_page_lists_every_parameter_with_its_default():
    text = (Path(__file__).parents[2] / "docs" / "howto" / "ros2.md").read_text()
    for each in dataclasses.fields(NodeSettings):
        rows = [line for line in text.splitlines() if line.startswith(f"| `{each.name}`")]
        assert len(rows) == 1 and each.metadata["meaning"] in rows[0], each.name
        default = f"[{', '.join(each.default)}]" if isinstance(each.default, tuple) else str(each.default)
        shown = rows[0].split("|")[2].strip(" `")
        assert shown.replace("_", "").lower() == (default or "''").replace("_", "").lower(), each.name


@pytest.mark.parametrize(
    "footprint",
    ["", "[]", "[[0, 0], [1, 1]]", "[[0, 0], [1, 1], [2, 2]]", '["12", "34", "56"]', "[[0, 0], [1, 0], [NaN, 1]]"],
)
def test_footprints_that_are_none_are_refused(footprint):
    with pytest.raises(ValueError, match="footprint: must"):
        NodeSettings(footprint=footprint)


def test_the_page_lists_every_topic_and_service_with_its_type():
    text = (Path(__file__).parents[2] / "docs" / "howto" / "ros2.md").read_text()
    for name, kind in [(name, topic.type) for name, topic in TOPICS.items()] + list(SERVICES.items()):
        rows = [line for line in text.splitlines() if line.startswith(f"| `~/{name}` |")]
        package, _, short = kind.split("/")
        assert len(rows) == 1 and f"{package}/{short}" in rows[0], name
        if name in TOPICS:
            assert ("transient local" in rows[0]) == TOPICS[name].is_latched
