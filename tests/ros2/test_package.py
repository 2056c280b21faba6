"""The ROS 2 package in examples/ros2: its files fit the node, and its version that of torchelev. Needs no ROS."""

import ast
import json
import re
import runpy
import sys
import types
import xml.etree.ElementTree as ElementTree
from pathlib import Path

import pytest
import yaml

from torchelev import ElevationMapConfig
from torchelev.ros2.outputs import SERVICES, TOPICS
from torchelev.ros2.settings import read_node_file

ROOT = Path(__file__).resolve().parents[2]
PACKAGE = ROOT / "examples/ros2/torchelev_ros"
DISPLAYS = {"OccupancyGrid": "Map"}  # RViz's name where it is not that of the message
NODE = "elevation_mapping"


def displays():
    rviz = yaml.safe_load((PACKAGE / "rviz/elevation_mapping.rviz").read_text())["Visualization Manager"]
    return rviz, [each for each in rviz["Displays"] if "Topic" in each]


def layout():
    return json.loads((PACKAGE / "foxglove/elevation_mapping.json").read_text())


def project():
    text = (ROOT / "pyproject.toml").read_text()  # Python 3.10 has no tomllib
    version = re.search(r'^version = "(.*)"$', text, re.MULTILINE).group(1)
    licence = re.search(r"License :: OSI Approved :: (\w+) License", text).group(1)
    return version, licence


def call_of_setup():
    tree = ast.parse((PACKAGE / "setup.py").read_text())
    calls = [node.value for node in tree.body if isinstance(node, ast.Expr) and isinstance(node.value, ast.Call)]
    (call,) = calls
    return {key.arg: key.value for key in call.keywords}


def test_rviz_shows_what_the_node_publishes_with_its_durability():
    rviz, found = displays()
    assert rviz["Global Options"]["Fixed Frame"] == "odom"
    assert [each["Class"].rpartition("/")[2] for each in found] == ["PointCloud2", "GridMap", "Map"] + [
        "MarkerArray"
    ] * 2
    for each in found:
        name = each["Topic"]["Value"]
        assert name.startswith(f"{NODE}/"), "relative, so that it follows the namespace"
        topic = TOPICS[name.removeprefix(f"{NODE}/")]
        kind, durability = topic.type.rpartition("/")[2], "Transient Local" if topic.is_latched else "Volatile"
        assert each["Class"].rpartition("/")[2] == DISPLAYS.get(kind, kind)
        assert each["Topic"]["Durability Policy"] == durability and each["Topic"]["Reliability Policy"] == "Reliable"
    assert "rviz_default_plugins/TF" in [each["Class"] for each in rviz["Displays"]]


def test_rviz_colours_by_layers_that_the_node_publishes():
    settings, _ = read_node_file(PACKAGE / "config/robot.yaml")
    (grid_map,) = [each for each in displays()[1] if each["Class"] == "grid_map_rviz_plugin/GridMap"]
    assert {grid_map["Height Layer"], grid_map["Color Layer"]} <= set(settings.layers)


def test_foxglove_shows_what_the_node_publishes():
    panels = layout()["configById"]
    shown = panels["3D!map"]["topics"]
    assert set(shown) == {f"/{NODE}/{name}" for name in ("points", "map", "costmap", "planes", "body")}
    paths = [each["value"] for name, panel in panels.items() if name.startswith("Plot!") for each in panel["paths"]]
    topics = {path.partition(".")[0] for path in paths}
    assert topics <= {"/diagnostics", *(f"/{NODE}/{name}" for name in TOPICS)}
    assert panels["DiagnosticSummary!status"]["topicToRender"] == "/diagnostics"
    service = panels["CallService!save_map"]
    assert service["serviceName"].removeprefix(f"/{NODE}/") in SERVICES and json.loads(service["requestPayload"]) == {}


def test_foxglove_plots_counts_that_the_diagnostics_have():
    from torchelev.ros2.intake import Counts

    keys = re.findall(r'\{key=="(\w+)"\}', json.dumps(layout()).replace('\\"', '"'))
    assert len(keys) == 4 and set(keys) <= set(Counts().as_dict())


def test_foxglove_places_every_panel_once():
    found = layout()

    def names(part):
        return [part] if isinstance(part, str) else [*names(part["first"]), *names(part["second"])]

    assert sorted(names(found["layout"])) == sorted(found["configById"])


@pytest.mark.parametrize("path", sorted((PACKAGE / "config").glob("*.yaml")), ids=lambda path: path.name)
def test_the_configs_are_read(path):
    settings, cfg = read_node_file(path)
    ElevationMapConfig.from_dict(cfg)
    assert not any(topic.startswith("/") for topic in (*settings.clouds, *settings.depths, *settings.camera_infos))


def test_name_version_and_licence_are_those_of_torchelev():
    version, licence = project()
    root = ElementTree.parse(PACKAGE / "package.xml").getroot()
    assert root.get("format") == "3" and root.findtext("export/build_type") == "ament_python"
    setup = call_of_setup()
    of_setup = ["torchelev_ros", *(ast.literal_eval(setup[key]) for key in ("version", "license", "description"))]
    of_package = [root.findtext(key) for key in ("name", "version", "license", "description")]
    assert of_setup == of_package and of_package[:3] == ["torchelev_ros", version, licence]
    assert "NAME = 'torchelev_ros'" in ast.unparse(ast.parse((PACKAGE / "setup.py").read_text()))
    assert (PACKAGE / "resource/torchelev_ros").exists()


def test_the_readme_lists_the_arguments_of_the_launch_file():
    text = (PACKAGE / "launch/elevation_mapping.launch.py").read_text()
    (table,) = [node for node in ast.parse(text).body if isinstance(node, ast.AnnAssign)]
    names = [row.elts[0].value for row in table.value.elts]
    rows = re.findall(r"^\| `(\w+)` \|", (PACKAGE / "README.md").read_text(), re.MULTILINE)
    assert rows == names and {"config", "namespace", "use_sim_time", "rviz", "log_level"} <= set(names)
    assert len((PACKAGE / "README.md").read_text().splitlines()) <= 40


def run_executable(monkeypatch, arguments):
    monkeypatch.setattr(sys, "argv", ["elevation_mapping", *arguments])
    runpy.run_path(str(PACKAGE / "torchelev_ros/__init__.py"))["main"]()


def test_the_executable_is_the_command_of_the_environment(monkeypatch):
    called = []
    monkeypatch.setattr("shutil.which", lambda name: f"/env/bin/{name}")
    monkeypatch.setattr("os.execv", lambda *call: called.append(call) or sys.exit(0))
    with pytest.raises(SystemExit):
        run_executable(monkeypatch, ["--config", "robot.yaml"])
    assert called == [("/env/bin/torchelev", ["/env/bin/torchelev", "ros2", "--config", "robot.yaml"])]


def test_the_executable_imports_torchelev_where_there_is_no_command(monkeypatch):
    called = []
    monkeypatch.setattr("shutil.which", lambda name: None)
    fake = types.SimpleNamespace(run=lambda: called.append(list(sys.argv)))
    monkeypatch.setitem(sys.modules, "torchelev.__main__", fake)
    run_executable(monkeypatch, ["--ros-args", "-r", "__ns:=/spot"])
    assert called == [["torchelev", "ros2", "--ros-args", "-r", "__ns:=/spot"]]


def test_the_executable_says_where_torchelev_is_missing(monkeypatch):
    monkeypatch.setattr("shutil.which", lambda name: None)
    monkeypatch.setitem(sys.modules, "torchelev.__main__", None)
    with pytest.raises(SystemExit, match="nor torchelev in PATH; activate its virtual environment"):
        run_executable(monkeypatch, [])
