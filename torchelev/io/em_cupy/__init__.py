"""Configs of elevation_mapping_cupy, for maps of torchelev.

    found = load_config("core_param.yaml", "plugin_config.yaml", "sensor_parameter.yaml")
    emap = ElevationMap(found.cfg)
    for note in found.notes:
        print(note)

Read against its `main` at 20a8a26 and `ros2_py` at e54a941. docs/howto/from_elevation_mapping.md has topics and
services.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any, NamedTuple

from torchelev.config import ElevationMapConfig
from torchelev.errors import require
from torchelev.files.config_files import read_settings
from torchelev.io.em_cupy.channels import GROUPS, read_channels
from torchelev.io.em_cupy.parameters import NODE_PARAMETERS, PARAMETERS, SWITCHES, read_parameters, read_same_parameters
from torchelev.io.em_cupy.plugins import PLUGINS, is_plugin, read_plugins


class Converted(NamedTuple):
    """A config that was read."""

    cfg: ElevationMapConfig  #: with filters and channels
    notes: tuple[str, ...]  #: a sentence for each parameter that has no equal here, or another meaning


def load_config(
    core: str | Path,
    plugins: str | Path | None = None,
    sensor: str | Path | None = None,
    *,
    channels: Iterable[str] = (),
    same_heights: bool = False,
) -> Converted:
    """Read the config of elevation_mapping_cupy.

    Settings that mean the same are taken over, also in other units. What has another meaning keeps its default here,
    and what has no equal is left out; a note says so. With `same_heights`, the map computes as that package does, see
    `ElevationMapConfig.like_em_cupy`: then nearly all parameters mean the same.

    Args:
        core: core_param.yaml, of ROS 1 or ROS 2; a later file's settings replace those of an earlier one.
        plugins: plugin_config.yaml; the plugins become `cfg.filters`.
        sensor: file with the sensors and their channels, such as <robot>_sensor_parameter.yaml.
        channels: names of channels that sensors send, as `channel_info` does, besides those that the files name.
        same_heights: compute heights, bounds and validity as elevation_mapping_cupy does, and let all points of a cell
            count for its channels; else as the paper, and those near its height.

    Raises:
        ValueError: a file cannot be read, holds a parameter or plugin that the package does not have, or a value that
            does not fit.
    """
    given = _settings_of(core)
    hint = "give core_param.yaml first, then plugin_config.yaml, then the sensors' file"
    has_parameter = any(name in PARAMETERS or name in SWITCHES for name in given)
    require(has_parameter, f"core, {core}", "must hold parameters of the map", ", ".join(given) or "nothing", hint)
    if plugins is not None:
        of_plugins = _settings_of(plugins)
        others = [name for name, value in of_plugins.items() if not (name in PLUGINS or is_plugin(value))]
        require(not others, f"plugins, {plugins}", "must hold plugins alone", ", ".join(others), hint)
        given |= of_plugins
    if sensor is not None:
        given |= _settings_of(sensor)
    names = [name for name in given if name in PLUGINS or is_plugin(given[name])]
    filters, plugin_notes = read_plugins({name: given.pop(name) for name in names})
    fusions = {name: given.pop(name) for name in GROUPS if name in given}
    average_weight = given.get("average_weight", 0.5)
    is_share = isinstance(average_weight, int | float) and 0 <= average_weight < 1
    require(is_share, "average_weight", "must lie in [0, 1)", repr(average_weight), "give 0.5")
    sent = (*_sent(given.get("subscribers")), *channels)
    parsed, channel_notes = read_channels(fusions, tuple(dict.fromkeys(sent)), average_weight, same_heights)
    settings, notes = read_same_parameters(given, Path(core).parent) if same_heights else read_parameters(given)
    settings |= {"filters": [step.to_dict() for step in filters], "channels": parsed}
    return Converted(ElevationMapConfig.from_dict(settings), (*notes, *plugin_notes, *channel_notes))


def _sent(subscribers: Any) -> list[str]:
    """Return the channels that the subscribers of a sensors' file name."""
    groups = subscribers.values() if isinstance(subscribers, Mapping) else ()
    lists = (group.get("channels") for group in groups if isinstance(group, Mapping))
    return [str(name) for names in lists if isinstance(names, list) for name in names]


def _settings_of(path: str | Path) -> dict[str, Any]:
    """Return the settings of a file, those of ROS 2 without the names of nodes around them."""
    values = read_settings(path)
    while len(values) == 1 and isinstance(inner := next(iter(values.values())), dict) and not is_plugin(inner):
        if next(iter(values)) in (*PLUGINS, *GROUPS, *NODE_PARAMETERS):
            break
        values = inner
    return values
