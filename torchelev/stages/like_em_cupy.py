"""The settings by which the stages compute as elevation_mapping_cupy does, by its own parameters."""

from __future__ import annotations

import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from torchelev.errors import require

#: Parameters that mean the same in this mode, with the values of its core_param.yaml.
DEFAULTS: dict[str, float] = {
    "resolution": 0.04,
    "map_length": 8.0,
    "sensor_noise_factor": 0.05,
    "mahalanobis_thresh": 2.0,
    "outlier_variance": 0.01,
    "drift_compensation_variance_inlier": 0.1,
    "max_drift": 0.1,
    "drift_compensation_alpha": 0.1,
    "time_variance": 0.0001,
    "update_variance_fps": 5.0,
    "max_variance": 100.0,
    "initial_variance": 1000.0,
    "traversability_inlier": 0.9,
    "dilation_size": 3,
    "wall_num_thresh": 20,
    "min_height_drift_cnt": 100,
    "min_valid_distance": 0.5,
    "max_height_range": 1.0,
    "ramped_height_range_a": 0.3,
    "ramped_height_range_b": 1.0,
    "ramped_height_range_c": 0.2,
    "max_ray_length": 10.0,
    "cleanup_step": 0.1,
    "cleanup_cos_thresh": 0.1,
    "overlap_clear_range_xy": 4.0,
    "overlap_clear_range_z": 2.0,
    "enable_edge_sharpen": True,
    "enable_drift_compensation": True,
    "enable_visibility_cleanup": True,
    "enable_overlap_clearance": True,
}
FARTHEST = 1e4  # [m] from the sensor: that package has no such limit
NOISE_FLOOR = 1e-9  # [m^2] nor this: small enough not to count
MIN_TIME = 0.5  # [s] its constant


def settings_like_em_cupy(parameters: Mapping[str, Any], weights: str | Path | None = None) -> dict[str, Any]:
    """Return the config's settings, by group and name, for parameters of elevation_mapping_cupy's core_param.yaml.

    Raises:
        ValueError: for a parameter that is not among `DEFAULTS`, or no number.
    """
    for name, value in parameters.items():
        require(
            name in DEFAULTS, name, "must be a parameter of the mode", repr(name), f"there are {', '.join(DEFAULTS)}"
        )
        is_number = isinstance(value, int | float) and math.isfinite(value)
        require(is_number, name, "must be a number", repr(value), "give a number without quotes")
    p = {**DEFAULTS, **parameters}
    groups = {"sensor": _sensor(p), "aging": {"variance_rate": p["time_variance"] * p["update_variance_fps"]}}
    groups |= {"grid": _grid(p), "fusion": _fusion(p), "surface": _surface(p, weights)}
    switches = {"drift": "drift_compensation", "raycast": "visibility_cleanup", "overlap": "overlap_clearance"}
    optional = {"drift": _drift(p), "raycast": _raycast(p), "overlap": _overlap(p)}
    return groups | {name: optional[name] if p[f"enable_{switch}"] else None for name, switch in switches.items()}


def _grid(p: Mapping[str, Any]) -> dict[str, Any]:
    for name in ("resolution", "map_length"):
        require(p[name] > 0, name, "must be positive", p[name], "give metres")
    length = round(p["map_length"] / p["resolution"]) * p["resolution"]
    return {"resolution": p["resolution"], "length_x": length, "length_y": length}


def _sensor(p: Mapping[str, Any]) -> dict[str, Any]:
    ramp = dict(zip(("slope", "distance", "offset"), (p[f"ramped_height_range_{k}"] for k in "abc"), strict=True))
    return {
        "depth": {"factor": p["sensor_noise_factor"]},
        "noise_factor": 0.0,
        "noise_floor": NOISE_FLOOR,
        "min_distance": p["min_valid_distance"],
        "max_distance": FARTHEST,
        "exclusion": ramp | {"height": p["max_height_range"]},
    }


def _fusion(p: Mapping[str, Any]) -> dict[str, Any]:
    averaging = {
        "gate_per_variance": p["mahalanobis_thresh"],
        "variance_per_outlier": p["outlier_variance"],
        "unknown_variance": p["initial_variance"],
        "wall_points": int(p["wall_num_thresh"]) if p["enable_edge_sharpen"] else None,
    }
    return {"max_variance": p["max_variance"], "averaging": averaging}


def _drift(p: Mapping[str, Any]) -> dict[str, Any]:
    return {
        "gain": p["drift_compensation_alpha"],
        "max_variance": p["drift_compensation_variance_inlier"] / 2,
        "min_traversability": p["traversability_inlier"],
        "min_points": int(p["min_height_drift_cnt"]) + 1,
        "max_drift": p["max_drift"],
        "inliers": {"gate_per_variance": p["mahalanobis_thresh"]},
    }


def _raycast(p: Mapping[str, Any]) -> dict[str, Any]:
    steps = {"validity_per_ray": p["cleanup_step"], "variance_per_ray": p["outlier_variance"]}
    settings = {"max_range": p["max_ray_length"], "min_incidence": p["cleanup_cos_thresh"], "min_time": MIN_TIME}
    return settings | {"steps": steps}


def _overlap(p: Mapping[str, Any]) -> dict[str, Any]:
    side, height = p["overlap_clear_range_xy"], p["overlap_clear_range_z"]
    return {"radius": side / 2, "height": height, "square": {"side": side, "height": height}}


def _surface(p: Mapping[str, Any], weights: str | Path | None) -> dict[str, Any]:
    return {"upper_bound": {"dilation": int(p["dilation_size"]), "filter_weights": weights}}
