"""The page for users of other elevation mapping nodes names what exists, and its example is read."""

import dataclasses
import re

import yaml

from tests.docs.markdown import DOCS, code_blocks
from torchelev import ElevationMap, ElevationMapConfig, filters
from torchelev.ros2 import outputs
from torchelev.ros2.settings import NodeSettings, make_settings, split

PAGE = (DOCS / "howto/from_elevation_mapping.md").read_text()


def here():
    """The middle cells of all tables: what stands for theirs."""
    rows = [row.split(" | ") for row in re.findall(r"^\| (.*) \|$", PAGE, re.MULTILINE)]
    return "\n".join(row[1] for row in rows)


def test_settings_of_the_map_exist():
    found = set(re.findall(r"`map\.([\w.]+)", PAGE))
    defaults = ElevationMapConfig().to_dict()
    assert len(found) > 25
    for name in found:
        group = defaults
        for part in name.split("."):
            assert part in group, name
            group = group[part]


def test_parameters_topics_and_services_exist():
    assert set(re.findall(r"~/(\w+)", PAGE)) <= outputs.TOPICS.keys() | outputs.SERVICES
    parameters = {each.name for each in dataclasses.fields(NodeSettings)}
    known = parameters | set(filters.FILTERS) | {"validity"}
    assert not set(re.findall(r"`([a-z]\w*)`", here())) - known


def test_the_example_is_read():
    _, ours = [yaml.safe_load(block.code) for block in code_blocks(PAGE) if block.language == "yaml"]
    values, cfg = split(ours)
    settings = make_settings(values)
    emap = ElevationMap(ElevationMapConfig.from_dict(cfg))
    assert set(settings.layers) <= set(emap.layers)
