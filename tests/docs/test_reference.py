"""The reference names every setting, statistic, layer, filter and export; a page that forgets one fails here."""

import dataclasses
import inspect
import pydoc
import re

import pytest

import torchelev
from tests.docs.markdown import DOCS
from torchelev.filters import FILTERS
from torchelev.layers import LAYERS
from torchelev.levels import LAYERS as LEVEL_LAYERS

REFERENCE = DOCS / "reference"
TABLES = re.findall(
    r"^```\{fields\} ([\w.]+)\n(.*?)^```$",
    "\n".join(path.read_text() for path in sorted(REFERENCE.glob("*.md"))),
    re.DOTALL | re.MULTILINE,
)


def fields_of(cls):
    return [field.name for field in dataclasses.fields(cls)] if dataclasses.is_dataclass(cls) else list(cls._fields)


def test_every_config_and_the_statistics_have_a_table():
    configs = {f"torchelev.{name}" for name in torchelev.__all__ if name.endswith("Config")}
    shapes = {f"torchelev.{name}" for name in ("RobotBody", "Capsule", "Box")}
    assert configs | shapes | {"torchelev.Statistics", "torchelev.MapState"} == {name for name, _ in TABLES}


@pytest.mark.parametrize("name, body", TABLES, ids=[name for name, _ in TABLES])
def test_a_table_says_a_sentence_about_every_field(name, body):
    said = re.findall(r"^(\w+): \S", body, re.MULTILINE)
    assert said == fields_of(pydoc.locate(name)) or (name == "torchelev.MapState" and not said)


def test_every_layer_has_a_row():
    rows = re.findall(r"^\| (`.*?`) \|", (REFERENCE / "layers.md").read_text(), re.MULTILINE)
    assert re.findall(r"`(\w+)`", " ".join(rows)) == [*LAYERS, *LEVEL_LAYERS]


def test_every_filter_is_shown_once_with_its_picture():
    shown = " ".join(re.findall(r"^```\{filters\} (.*)$", (REFERENCE / "filters.md").read_text(), re.MULTILINE)).split()
    own = {name for name, function in FILTERS.items() if function.__module__.startswith("torchelev.")}
    assert sorted(shown) == sorted(own)
    pictures = {path.stem: path.stat().st_size for path in (DOCS / "pictures/filters").glob("*.png")}
    assert own | {"elevation"} == set(pictures), "run python -m docs.reference_pictures"
    assert max(pictures.values()) < 10_000


def test_every_export_is_on_the_page_of_the_api():
    named = re.findall(r"auto(?:class|function):: torchelev\.(\w+)$", (REFERENCE / "api.md").read_text(), re.MULTILINE)
    assert sorted(named) == sorted(torchelev.__all__)


def test_every_public_module_of_a_named_room_exists():
    pages = "\n".join(path.read_text() for path in (REFERENCE / "api").glob("*.md"))
    named = re.findall(r"auto\w+:: ([\w.]+)$", pages, re.MULTILINE)
    assert len(named) > 30 and all(inspect.ismodule(thing) or callable(thing) for thing in map(pydoc.locate, named))
