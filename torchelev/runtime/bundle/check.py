"""Replay a bundle's episode by Python, by the C library and by onnxruntime, and say where they first differ."""

from __future__ import annotations

import ctypes
import json
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from torchelev.elevation_map import ElevationMap
from torchelev.errors import require
from torchelev.observations.height_scan import HeightScan
from torchelev.observations.map_image import MapImage
from torchelev.runtime.bundle.bundle import Bundle
from torchelev.runtime.bundle.groups import Group, image_settings, scan_settings, shape_of
from torchelev.runtime.bundle.recording import CONFIG, POLICY
from torchelev.runtime.library import CMap, LibraryError

TOLERANCE = 1e-4  # of what was recorded: on another device, and by a layout whose points are rounded to micrometres

Values = dict[str, NDArray]  # of one step, by group


@dataclass(frozen=True)
class Result:
    """One comparison."""

    name: str  #: what was compared with what
    passed: bool | None  #: None: it was not compared
    text: str  #: the largest difference, where the first one is, or why there was no comparison


def check_bundle(bundle: Bundle, library: ctypes.CDLL | None) -> Iterator[Result]:
    """Yield the results of all comparisons as they are there. `library` is the C library; None: there is none."""
    recorded = [_recorded(bundle, step) for step in range(bundle.num_steps)]
    python = list(_replay(bundle, _PythonMap(bundle)))
    yield _compare("the map in Python, with the recording", recorded, python, TOLERANCE)
    if library is None:
        yield Result(
            "the C library, with the map in Python", None, "there is no library: install g++, or give --library"
        )
    else:
        yield _check_library(bundle, library, python)
    yield _check_policy(bundle, recorded)


def _reading_groups(bundle: Bundle) -> dict[str, Group]:
    """Return the groups that read the map."""
    return {name: group for name, group in bundle.groups.items() if isinstance(group, HeightScan | MapImage)}


def _recorded(bundle: Bundle, step: int) -> Values:
    return {name: bundle.episode[f"step_group_{name}"][step] for name in _reading_groups(bundle)}


def _replay(bundle: Bundle, emap: Any) -> Iterator[Values]:
    """Yield what a map's groups read at each step."""
    feet = bundle.episode.get("step_feet")
    for step in range(bundle.num_steps):
        for inputs in bundle.updates(step):
            if inputs.pop("resets"):
                emap.reset()
            emap.update(inputs)
        if bundle.episode["step_resets"][step]:
            emap.reset()
        T_map_base = bundle.episode["step_T_map_base"][step]
        yield emap.read(T_map_base, None if feet is None else feet[step])


class _PythonMap:
    def __init__(self, bundle: Bundle) -> None:
        self.emap, self.groups = ElevationMap(bundle.cfg), _reading_groups(bundle)

    def reset(self) -> None:
        self.emap.reset()

    def update(self, inputs: dict[str, Any]) -> None:
        tensors = {name: torch.from_numpy(np.array(v))[None] for name, v in inputs.items() if name != "dt"}
        self.emap.update(dt=float(inputs["dt"]), **tensors)

    def read(self, T_map_base: NDArray, feet: NDArray | None) -> Values:
        T = torch.from_numpy(T_map_base)[None]
        values = {}
        for name, group in self.groups.items():
            if isinstance(group, HeightScan):
                around = torch.from_numpy(feet)[None] if group.num_feet and feet is not None else None
                values[name] = group(self.emap, T, around)[0][0].numpy()
            elif isinstance(group, MapImage):
                values[name] = group(self.emap, T)[0].numpy()
        return values


class _LibraryMap:
    def __init__(self, bundle: Bundle, library: ctypes.CDLL) -> None:
        points = bundle.episode["update_points"]
        sensors = points.shape[1] if points.ndim == 4 else 1
        limits = max(1, points[0].size // 3), sensors
        self.emap = CMap(library, bundle.folder / CONFIG, *limits)
        groups = _reading_groups(bundle)
        scans = {name: group for name, group in groups.items() if isinstance(group, HeightScan)}
        layouts = {name: json.dumps(scan_settings(scan)) for name, scan in scans.items()}
        self.scans = {name: self.emap.scan(layout) for name, layout in layouts.items()}
        self.feet = {name: scan.num_feet for name, scan in scans.items()}
        settings = {name: image_settings(group) for name, group in groups.items() if isinstance(group, MapImage)}
        self.images = {name: self.emap.image(json.dumps(values)) for name, values in settings.items()}

    def reset(self) -> None:
        self.emap.reset()

    def update(self, inputs: dict[str, Any]) -> None:
        def per_sensor(name: str, ndim: int) -> Any:
            value = inputs.get(name)
            return value if value is None or value.ndim == ndim else value[None]

        covariance, sensors = per_sensor("pose_covariance", 3), per_sensor("T_map_sensor", 3)
        if covariance is not None:  # one may be given for all sensors
            covariance = np.broadcast_to(covariance, (len(sensors), 6, 6))
        self.emap.update(
            per_sensor("points", 3),
            sensors,
            inputs.get("T_map_base"),
            float(inputs["dt"]),
            per_sensor("variance", 2),
            covariance,
            inputs.get("T_base_links"),
        )

    def read(self, T_map_base: NDArray, feet: NDArray | None) -> Values:
        values = {name: scan(T_map_base, feet if self.feet[name] else None)[0] for name, scan in self.scans.items()}
        return values | {name: image(T_map_base) for name, image in self.images.items()}


def _check_library(bundle: Bundle, library: ctypes.CDLL, python: list[Values]) -> Result:
    name = "the C library, with the map in Python"
    try:
        found = list(_replay(bundle, _LibraryMap(bundle, library)))
    except LibraryError as error:
        return Result(name, None if error.status == 3 else False, str(error))
    return _compare(name, python, found, 0.0)


def _compare(name: str, wanted: list[Values], found: list[Values], tolerance: float) -> Result:
    largest = 0.0
    for step, (row, other) in enumerate(zip(wanted, found, strict=True)):
        for group, values in row.items():
            apart = np.abs(values.astype(np.float64) - other[group].astype(np.float64)).ravel()
            bad = ~(apart <= tolerance)
            if bad.any():
                k = int(bad.argmax())
                a, b = values.ravel()[k], other[group].ravel()[k]
                where = f"{group} first differs at step {step}, value {k}: {b:.6g} instead of {a:.6g}"
                return Result(name, False, f"{where}, {apart[k]:.3g} apart; {int(bad.sum())} of {bad.size} values do")
            largest = max(largest, float(apart.max(initial=0.0)))
    return Result(name, True, f"{len(wanted)} steps, largest difference {largest:.3g}")


# The policy ---------------------------------------------------------------------------------------------------------


def _check_policy(bundle: Bundle, recorded: list[Values]) -> Result:
    """Compare the actions of onnxruntime with the recorded ones."""
    run = open_policy(bundle)
    groups = {name: bundle.episode[f"step_group_{name}"] for name in bundle.groups}
    found = [{"action": run({name: values[k] for name, values in groups.items()})} for k in range(bundle.num_steps)]
    wanted = [{"action": action} for action in bundle.episode["step_action"]]
    return _compare("the policy in onnxruntime, with the recording", wanted, found, TOLERANCE)


def open_policy(bundle: Bundle) -> Callable[[Values], NDArray]:
    """Return the policy in onnxruntime, which takes the groups (...) by name and returns an action (A).

    Raises:
        ValueError: it takes other groups than the bundle describes.
        ModuleNotFoundError: onnxruntime is not installed.
    """
    import onnxruntime

    path = bundle.folder / POLICY
    try:
        session = onnxruntime.InferenceSession(str(path), providers=["CPUExecutionProvider"])
    except Exception as error:  # onnxruntime's own kinds
        raise ValueError(f"{path}: cannot be read ({error}); export the run again") from error
    inputs, shapes = session.get_inputs(), {name: shape_of(group) for name, group in bundle.groups.items()}
    if len(inputs) == 1 and all(len(shape) == 1 for shape in shapes.values()):
        wanted: dict[str, tuple[int, ...]] = {inputs[0].name: (sum(shape[0] for shape in shapes.values()),)}
    else:
        require(
            len(inputs) == len(shapes),
            str(path),
            f"must take {', '.join(shapes)}",
            [i.name for i in inputs],
            "export it again",
        )
        wanted = {i.name: shape for i, shape in zip(inputs, shapes.values(), strict=True)}
    for entry in inputs:
        actual = tuple(size for size in entry.shape[1:])
        rule = f"must take {wanted[entry.name]} values, as the groups {', '.join(shapes)} have"
        require(actual == wanted[entry.name], f"{path}, {entry.name}", rule, actual, "export the run again")

    def act(groups: Values) -> NDArray:
        values = [groups[name].astype(np.float32)[None] for name in shapes]
        values = [np.concatenate(values, -1)] if len(inputs) == 1 < len(values) else values
        return session.run(None, dict(zip(wanted, values, strict=True)))[0][0]

    return act
