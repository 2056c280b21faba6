"""The pages for users of other elevation maps name what exists, and their examples are read."""

import dataclasses
import re

import pytest
import yaml

from tests.docs.markdown import DOCS, code_blocks
from torchelev import ElevationMap, ElevationMapConfig, filters
from torchelev.ros2 import outputs
from torchelev.ros2.settings import NodeSettings, make_settings, split

PAGES = {name: (DOCS / f"howto/from_{name}.md").read_text() for name in ("elevation_mapping", "grid_map", "fastdem")}
each_page = pytest.mark.parametrize("page", PAGES.values(), ids=PAGES)


def here(page):
    """The middle cells of the tables of parameters, topics and layers: what stands for theirs."""
    tables = re.findall(r"^\|[^\n]*\| Difference \|\n(.*?)(?:\n\n|\Z)", page, re.MULTILINE | re.DOTALL)
    rows = [row.split(" | ") for table in tables for row in re.findall(r"^\| (.*) \|$", table, re.MULTILINE)]
    return "\n".join(row[1] for row in rows if len(row) > 1)


@each_page
def test_settings_of_the_map_exist(page):
    found = set(re.findall(r"`map\.([\w.]+)", here(page)))
    defaults = ElevationMapConfig().to_dict()
    assert len(found) > 10
    for name in found:
        group = defaults
        for part in name.split("."):
            assert part in group, name
            group = group[part]


@each_page
def test_parameters_topics_services_layers_and_filters_exist(page):
    assert set(re.findall(r"~/(\w+)", page)) <= outputs.TOPICS.keys() | outputs.SERVICES
    parameters = {each.name for each in dataclasses.fields(NodeSettings)}
    known = parameters | set(filters.FILTERS) | set(ElevationMap().layers) | {"pose_covariance", "clamp", "where"}
    assert not set(re.findall(r"`([a-z]\w*)`", here(page))) - known


@each_page
def test_the_example_is_read(page):
    _, ours = [yaml.safe_load(block.code) for block in code_blocks(page) if block.language == "yaml"]
    values, cfg = split(ours)
    settings = make_settings(values)
    emap = ElevationMap(ElevationMapConfig.from_dict(cfg))
    assert set(settings.layers) <= set(emap.layers)
