"""The JSON schema of config files: as the settings are, and as strict."""

import json

import jsonschema
import pytest

from docs.config_schema import FILE, schema
from torchelev import BodyConfig, Capsule, ElevationMapConfig, RobotBody, SensorConfig, TraversabilityConfig
from torchelev.filters.chain import FilterConfig

CONFIGS = {
    "default": ElevationMapConfig(),
    "off": ElevationMapConfig(drift=None, raycast=None, overlap=None, traversability=None),
    "box": ElevationMapConfig(sensor=SensorConfig(body=BodyConfig(), exclusion=None)),
    "infinite": ElevationMapConfig(traversability=TraversabilityConfig(critical_slope=float("inf"))),
    "python": ElevationMapConfig(
        filters=(FilterConfig(layer="smooth", filter="gaussian", settings={"sigma": 0.1}),),
        sensor=SensorConfig(
            body=RobotBody(capsules=[Capsule(link="leg", start=(0, 0, 0), end=(0, 0, -0.4), radius=0.1)])
        ),
    ),
}


def test_the_file_is_current():
    assert json.loads(FILE.read_text()) == schema(), "run python -m docs.config_schema"


@pytest.mark.parametrize("name", CONFIGS)
def test_saved_configs_fit(tmp_path, name):
    CONFIGS[name].save(tmp_path / "map.json")
    values = json.loads((tmp_path / "map.json").read_text())
    jsonschema.validate(values, schema())
    (tmp_path / "map.json").write_text(json.dumps({"$schema": "map.schema.json", **values}))
    assert ElevationMapConfig.load(tmp_path / "map.json") == CONFIGS[name]


@pytest.mark.parametrize(
    "values",
    [
        {"grid": {"resolutoin": 0.1}},
        {"grid": {"resolution": "0.1"}},
        {"torchelev_config": 2},
        {"fusion": None},
        {"sensor": {"body": {"capsules": [{"link": "leg"}]}}},
        {"filters": [{"layer": "smooth"}]},
        {"completion": {"when": "read"}},
    ],
)
def test_what_is_refused_does_not_fit(values):
    with pytest.raises((ValueError, TypeError)):
        ElevationMapConfig.from_dict(values)
    with pytest.raises(jsonschema.ValidationError):
        jsonschema.validate(values, schema())


def test_units_are_told():
    grid = schema()["properties"]["grid"]["properties"]
    assert all(setting["description"].startswith("[m]") for setting in grid.values())
