"""A bundle: a run's files with hashes and versions, refused where its parts do not fit each other."""

from __future__ import annotations

import hashlib
import json
import shutil
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from torchelev.config import ElevationMapConfig
from torchelev.errors import require
from torchelev.files.output_files import atomic_file
from torchelev.observations.height_scan import HeightScan
from torchelev.observations.map_image import MapImage
from torchelev.runtime.bundle.groups import Group, from_json, shape_of
from torchelev.runtime.bundle.recording import CONFIG, EPISODE, OBSERVATION, POLICY, VERSION

MANIFEST = "bundle.json"
PARTS = (POLICY, CONFIG, OBSERVATION, EPISODE)
_AGAIN = "export the run again"


@dataclass(frozen=True)
class Bundle:
    """What a policy was trained with, read from a folder."""

    folder: Path  #: that it was read from
    cfg: ElevationMapConfig  #: of the map
    groups: dict[str, Group]  #: in the policy's order
    episode: dict[str, NDArray]  #: of `Recorder`

    @property
    def num_steps(self) -> int:
        """Number of recorded steps."""
        return len(self.episode["step_action"])

    def updates(self, step: int) -> Iterator[dict[str, Any]]:
        """Yield the inputs of the updates before a step; "resets" says whether the map is forgotten first."""
        arrays = {name.removeprefix("update_"): v for name, v in self.episode.items() if name.startswith("update_")}
        for k in np.flatnonzero(arrays["step"] == step):
            names = [name for name in arrays if not name.endswith("_given") and name != "step"]
            is_given = {name: f"{name}_given" not in arrays or arrays[f"{name}_given"][k] for name in names}
            yield {name: arrays[name][k] for name in names if is_given[name]}


def export_bundle(run: str | Path, out: str | Path) -> Bundle:
    """Copy a run's files to a new folder, with their hashes and the versions that made them.

    Args:
        run: the folder with policy.onnx and what `Recorder.write` wrote there.
        out: the bundle to make; one that is there is replaced.

    Raises:
        ValueError: a file is missing, or the parts do not fit each other.
        WriteError: the bundle cannot be written.
    """
    import torchelev

    run, out = Path(run), Path(out)
    for name in PARTS:
        hint = "train again, or record an episode with torchelev.runtime.bundle.recording.Recorder"
        require((run / name).is_file(), str(run / name), "must be there", "no file", hint)
    bundle = _read(run)
    others = {path.name for path in out.iterdir()} - {MANIFEST, *PARTS} if out.is_dir() else set()
    is_bundle = not out.exists() or (out.is_dir() and not others)
    require(is_bundle, str(out), "must be a new folder or an older bundle", "other files", "give another --out")
    out.mkdir(parents=True, exist_ok=True)
    (out / MANIFEST).unlink(missing_ok=True)  # until all parts are there
    for name in PARTS:
        with (run / name).open("rb") as source, atomic_file(out / name) as file:
            shutil.copyfileobj(source, file)
    versions = {"torchelev": torchelev.__version__, "torch": str(torch.__version__)}
    hashes = {name: _hash(out / name) for name in PARTS}
    manifest = {"torchelev_bundle": VERSION, "versions": versions, "sha256": hashes}
    with atomic_file(out / MANIFEST) as file:
        file.write((json.dumps(manifest, indent=1) + "\n").encode())
    return bundle


def read_bundle(folder: str | Path) -> Bundle:
    """Read a bundle.

    Raises:
        ValueError: it is none, of another version, changed since it was exported, or its parts do not fit each other.
    """
    folder = Path(folder)
    manifest = _read_json(folder / MANIFEST)
    for name in PARTS:
        is_there = (folder / name).is_file()
        require(is_there, str(folder / name), "must be there", "no file", _AGAIN)
        hashes = manifest.get("sha256")
        is_same = isinstance(hashes, dict) and _hash(folder / name) == hashes.get(name)
        require(is_same, str(folder / name), "must be as it was exported", "another hash", _AGAIN)
    return _read(folder)


def _hash(path: Path) -> str:
    return hashlib.sha256(path.read_bytes()).hexdigest()


def _read_json(path: Path) -> dict[str, Any]:
    try:
        values = json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError) as error:
        raise ValueError(f"{path}: cannot be read ({error}); {_AGAIN}") from error
    version = values.get("torchelev_bundle") if isinstance(values, dict) else None
    hint = "read it with a newer torchelev" if isinstance(version, int) else _AGAIN
    require(version == VERSION, str(path), f"must be of version {VERSION}", version, hint)
    return values


def _read(folder: Path) -> Bundle:
    cfg = ElevationMapConfig.load(folder / CONFIG)
    described = _read_json(folder / OBSERVATION)
    groups = from_json(str(folder / OBSERVATION), described.get("groups"))
    try:
        with np.load(folder / EPISODE, allow_pickle=False) as arrays:
            episode = {name: arrays[name] for name in arrays.files}
    except Exception as error:  # zipfile, zlib and NumPy raise all kinds
        raise ValueError(f"{folder / EPISODE}: damaged ({error}); {_AGAIN}") from error
    bundle = Bundle(folder, cfg, groups, episode)
    _require_fit(bundle)
    return bundle


def _require_fit(bundle: Bundle) -> None:
    """Refuse parts that do not fit each other, by their names."""
    episode, where = bundle.episode, str(bundle.folder / EPISODE)
    for name in (
        "step_action",
        "step_T_map_base",
        "step_resets",
        "update_step",
        "update_resets",
        "update_points",
        "update_T_map_sensor",
        "update_dt",
    ):
        require(name in episode, where, f"must have an array {name}", "none", _AGAIN)
    sizes = {prefix: {len(v) for k, v in episode.items() if k.startswith(prefix)} for prefix in ("step_", "update_")}
    for prefix, lengths in sizes.items():
        require(len(lengths) == 1, where, f"must have {prefix}* arrays of one length", sorted(lengths), _AGAIN)
    for name, group in bundle.groups.items():
        found = episode.get(f"step_group_{name}")
        shape = (bundle.num_steps, *shape_of(group))
        actual = None if found is None else found.shape
        require(actual == shape, f"{where}, group {name}", f"must be {shape}, as {OBSERVATION} says", actual, _AGAIN)
        if isinstance(group, HeightScan | MapImage):
            pattern = group.placement if isinstance(group, HeightScan) else group._pattern
            try:
                pattern.require_inside(bundle.cfg.grid)
            except ValueError as error:
                raise ValueError(f"{bundle.folder / CONFIG} and {OBSERVATION}, group {name}: {error}") from error
    links = bundle.cfg.sensor.links
    has_links = "update_T_base_links" in episode
    rule = "must have poses of the links of sensor.body, and only then"
    require(has_links == bool(links), where, rule, "poses" if has_links else "none", _AGAIN)
