"""The parameters of core_param.yaml: what they are called here, and what differs."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from pathlib import Path
from textwrap import shorten
from typing import Any, NamedTuple

from torchelev.errors import require
from torchelev.stages.like_em_cupy import DEFAULTS, settings_like_em_cupy

GONE = "has no equal"


class Rule(NamedTuple):
    """What becomes of a parameter."""

    setting: str = ""  #: the setting here, dotted; "" for none
    note: str = ""  #: what differs; "" if it means the same
    convert: Callable[[Any], Any] | None = None  #: its value as that setting; None: the default stays


def _same(value: Any) -> Any:
    return value


def _taken(setting: str, note: str = "") -> Rule:
    return Rule(setting, note, _same)


def _kept(setting: str, note: str) -> Rule:
    return Rule(setting, f"{note}; the default of {setting} is kept")


#: Parameters of core_param.yaml by name. Switches and lengths of the grid are converted apart.
PARAMETERS: dict[str, Rule] = {
    "resolution": _taken("grid.resolution"),
    "map_length": _taken("grid.length_x"),
    "sensor_noise_factor": _kept(
        "sensor.noise_factor", "grows with the squared depth, and is compared as a standard deviation"
    ),
    "mahalanobis_thresh": _kept("fusion.gate", "is in multiples of the variance there, in standard deviations here"),
    "outlier_variance": _kept("fusion.outlier_variance", "is added for each outlier there, for a whole scan here"),
    "time_variance": _kept("aging.variance_rate", "is added by a timer there, per second here"),
    "update_variance_fps": _kept("aging.variance_rate", "is the rate of a timer"),
    "max_variance": _kept("fusion.max_variance", "deletes cells above it there, and is a cap here"),
    "initial_variance": _kept("fusion.max_variance", "is the variance of unknown cells there, which have none here"),
    "initialized_variance": _kept("fusion.max_variance", "is what initialised cells get; here they get the largest"),
    "min_valid_distance": _taken("sensor.min_distance"),
    "max_height_range": _taken("sensor.exclusion.height"),
    "ramped_height_range_a": _taken("sensor.exclusion.slope"),
    "ramped_height_range_b": _taken(
        "sensor.exclusion.distance", "counts from the map's centre there, from the sensor here"
    ),
    "ramped_height_range_c": _taken("sensor.exclusion.offset"),
    "max_drift": _taken("drift.max_drift"),
    "drift_compensation_alpha": _taken("drift.gain"),
    "min_height_drift_cnt": Rule("drift.min_points", "", int),
    "drift_compensation_variance_inlier": _kept("drift.max_variance", "is halved, and is that of another variance"),
    "drift_compensation_variance_inler": Rule("", "is misspelled there, and has no effect"),
    "traversability_inlier": _kept("drift.min_traversability", "is that of another rating"),
    "position_noise_thresh": Rule("", f"{GONE}: give update(moving=False) while the robot stands"),
    "orientation_noise_thresh": Rule("", f"{GONE}: give update(moving=False) while the robot stands"),
    "position_lowpass_alpha": Rule("", f"{GONE}: give update(moving=False) while the robot stands"),
    "orientation_lowpass_alpha": Rule("", f"{GONE}: give update(moving=False) while the robot stands"),
    "wall_num_thresh": Rule("fusion.edges.min_points", "acts only where points spread wider than their noise", int),
    "max_ray_length": _taken("raycast.max_range"),
    "cleanup_cos_thresh": _taken("raycast.min_incidence"),
    "cleanup_step": Rule("", f"{GONE}: one accepted ray removes a cell; see raycast.min_time and raycast.min_support"),
    "overlap_clear_range_xy": Rule("overlap.radius", "is a side there, and a radius here: halved", lambda v: v / 2),
    "overlap_clear_range_z": _taken("overlap.height", "counts from the sensor there, from the robot here"),
    "dilation_size": _kept("traversability", "is that of another rating"),
    "use_chainer": _kept("traversability", "chooses what runs another rating"),
    "weight_file": _kept("traversability", "holds weights of another rating"),
    "checker_layer": Rule("", f"{GONE}: planning.check_path has limits of the robot"),
    "safe_thresh": Rule("", f"{GONE}: planning.check_path has limits of the robot"),
    "safe_min_thresh": Rule("", f"{GONE}: planning.check_path has limits of the robot"),
    "max_unsafe_n": Rule("", f"{GONE}: planning.check_path has limits of the robot"),
    "use_only_above_for_upper_bound": Rule("", f"{GONE}: every upper bound counts"),
    "dilation_size_initialize": Rule("", f"{GONE}: emap.initialize fills the hull of the feet, or the window"),
    "initialize_method": Rule("", "is an argument of emap.initialize"),
    "time_interval": Rule("", f"{GONE}: the layer time is exact"),
    "average_weight": Rule("", "becomes rate = 1 - average_weight of channels of class_average"),
    "cell_n": Rule("", "follows from resolution and map_length"),
    "data_type": Rule("", f"{GONE}: maps are float32, or of the dtype that emap.to gives"),
    "min_filter_size": Rule("", "has no effect there"),
    "min_filter_iteration": Rule("", "has no effect there"),
    "enable_normal": Rule("", f"{GONE}: normals are layers, computed with each update"),
    "enable_normal_color": Rule("", f"{GONE}: normals are layers"),
}


WITHOUT_WEIGHTS = (
    "weight_file: without the weights as .npz, the analytic head rates, and chooses the cells that measure the drift; "
    "see docs/howto/from_elevation_mapping.md"
)

#: Switches: the group that is left out, of which nothing else remains.
SWITCHES = {
    "enable_edge_sharpen": "fusion.edges",
    "enable_visibility_cleanup": "raycast",
    "enable_drift_compensation": "drift",
    "enable_overlap_clearance": "overlap",
}
#: Of the node, or of memory that this library does not have.
NODE_PARAMETERS = frozenset(
    "subscribers publishers map_frame base_frame corrected_map_frame pose_topic update_pose_fps map_acquire_fps "
    "publish_statistics_fps enable_pointcloud_publishing enable_drift_corrected_TF_publishing initialize_frame_id "
    "initialize_tf_offset initialize_tf_grid_size use_initializer_at_start plugin_config_file map_topic odom_frame "
    "pointcloud_topics recordable_fps use_sim_time".split()
)


def read_same_parameters(given: Mapping[str, Any], folder: Path) -> tuple[dict[str, Any], list[str]]:
    """Return the nested settings of a map that computes as elevation_mapping_cupy does, and the notes.

    The path of the weights is relative to `folder`.
    """
    same = {name: value for name, value in given.items() if name in DEFAULTS}
    same = {name: _switch(name, value) if name in SWITCHES else value for name, value in same.items()}
    path = str(given.get("weight_file", ""))
    weights = folder / path if path.endswith(".npz") else None
    if weights is not None:
        hint = "give its path from the folder of core_param.yaml"
        require(weights.exists(), "weight_file", "must be a file", weights, hint)
    taken = {*DEFAULTS, *(["weight_file"] if weights else [])}
    _, notes = read_parameters({name: value for name, value in given.items() if name not in taken})
    if weights is None:
        notes.append(WITHOUT_WEIGHTS)
    return settings_like_em_cupy(same, weights), notes + _length_note(same)


def read_parameters(given: Mapping[str, Any]) -> tuple[dict[str, Any], list[str]]:
    """Return nested settings, and the notes."""
    notes: list[str] = []
    settings: dict[str, Any] = {}
    known = (*PARAMETERS, *SWITCHES, *NODE_PARAMETERS)
    for name, value in given.items():
        hint = "correct it, or remove it; sensors and channels are in <robot>_sensor_parameter.yaml"
        require(name in known, name, "is no parameter of elevation_mapping_cupy", shorten(repr(value), 40), hint)
        if name in SWITCHES:
            if not _switch(name, value):
                _set(settings, SWITCHES[name], None)
        elif name in PARAMETERS:
            rule = PARAMETERS[name]
            if rule.convert is not None:
                _set(settings, rule.setting, _convert(name, value, rule))
            if rule.note:
                notes.append(f"{name} = {value}: {rule.note}")
    if "grid" in settings:
        notes += _square(settings["grid"])
    of_node = [name for name in given if name in NODE_PARAMETERS]
    notes += (
        [f"{', '.join(of_node)}: settings of the node, see docs/howto/from_elevation_mapping.md"] if of_node else []
    )
    return settings, notes


def _switch(name: str, value: Any) -> bool:
    require(isinstance(value, bool), name, "must be true or false", repr(value), "write it without quotes")
    return bool(value)


def _convert(name: str, value: Any, rule: Rule) -> Any:
    assert rule.convert is not None
    is_number = isinstance(value, int | float) and not isinstance(value, bool)
    is_substitution = isinstance(value, str) and value.startswith("$(")
    hint = "write what the launch file puts there" if is_substitution else "give a number without quotes"
    require(is_number, name, "must be a number", repr(value), hint)
    return rule.convert(value)


def _set(settings: dict[str, Any], path: str, value: Any) -> None:
    """Set a dotted setting, unless its group is switched off."""
    *groups, name = path.split(".")
    for group in groups:
        inner = settings.setdefault(group, {})
        if inner is None:
            return
        settings = inner
    settings[name] = value


def _square(grid: dict[str, Any]) -> list[str]:
    """Make the window a square of whole cells, in place; return a note if that changed its length."""
    resolution, length = grid.get("resolution", 0.04), grid.get("length_x", 8.0)
    for name, value in (("resolution", resolution), ("map_length", length)):
        require(value > 0, name, "must be positive", value, "give metres")
    cells = round(length / resolution)
    grid |= {"resolution": resolution, "length_x": cells * resolution, "length_y": cells * resolution}
    return _length_note({"resolution": resolution, "map_length": length})


def _length_note(given: Mapping[str, Any]) -> list[str]:
    """Return a note if a map of these parameters is not whole cells long."""
    resolution, length = (given.get(name, DEFAULTS[name]) for name in ("resolution", "map_length"))
    cells = round(length / resolution)
    notes = []
    if abs(cells * resolution - length) > 1e-6:
        notes.append(f"map_length = {length}: became {cells * resolution:g} m, {cells} whole cells")
    if cells % 2:
        notes.append(f"map_length = {length}: {cells} cells are an odd number, and lie half a cell beside those there")
    return notes
