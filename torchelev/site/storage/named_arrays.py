"""Arrays that a site holds beside its cells, such as keyframes, each as one file with metadata."""

from __future__ import annotations

import os
import re
from collections.abc import Iterable, Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from torchelev.errors import require
from torchelev.site.storage.site_header import CELLS
from torchelev.site.storage.transaction import COMMITTED, read_newest
from torchelev.site.storage.zarr_files import (
    METADATA,
    array_metadata,
    damaged,
    group_metadata,
    is_missing,
    open_array,
    read_metadata,
    wait_for,
    write_metadata,
)

NAME = re.compile(r"[A-Za-z0-9_-]+(/[A-Za-z0-9_-]+)*")
_CHUNKS = "c"  # folder of an array's chunks


def check_names(path: Path, names: list[str]) -> None:
    """Raise ValueError unless the names fit a folder: a name with others below it is a group, and no array.

    Looks at these names only: a site may have very many arrays.
    """
    require_names(names)
    groups = {"/".join(name.split("/")[:depth]): name for name in names for depth in range(1, name.count("/") + 1)}
    for group, name in groups.items():
        is_array = group in names or _read_kind(path, group) == "array"
        require(not is_array, "arrays", "must not lie below an array", repr(name), f"{group} is one")
    for name in names:
        is_group = name in groups or _read_kind(path, name) == "group"
        require(not is_group, "arrays", "must not have arrays below them", repr(name), "choose another name")


def require_names(names: Iterable[str]) -> None:
    """Raise ValueError unless all may be names of arrays."""
    for name in names:
        parts = name.split("/")
        is_name = NAME.fullmatch(name) and _CHUNKS not in parts and parts[0] != CELLS
        rule = f"must be named by letters, digits, _ and -, not {_CHUNKS} or {CELLS}"
        require(bool(is_name), "arrays", rule, repr(name), 'name them "keyframes/0001", say')


def _read_kind(path: Path, name: str) -> str:
    try:
        return str(read_newest(path, lambda folder: read_metadata(folder / name / METADATA))["node_type"])
    except FileNotFoundError:
        return "none"


def stage_array(path: Path, staged: Path, name: str, array: NDArray, attributes: Mapping[str, Any]) -> None:
    """Write an array, and the groups above it that `path` lacks, below the folder `staged`."""
    array = np.asarray(array)
    metadata = array_metadata(array, attributes)
    write_metadata(staged / name / METADATA, metadata)
    for group in Path(name).parents:
        if group.parts and not (path / group / METADATA).exists():
            write_metadata(staged / group / METADATA, group_metadata({}))
    if array.size:
        wait_for([open_array(staged / name, metadata).write(array)])


def read_array(path: Path, name: str) -> tuple[NDArray, dict[str, Any]]:
    """Read an array and its attributes, both of one commit, beside a writer too."""
    metadata, newest = None, _read_metadata(path, name)
    while newest != metadata:
        metadata, failure = newest, None
        try:
            values = _read_values(path, name, metadata)
        except ValueError as error:  # also when a commit has just changed the shape
            failure = error
        newest = _read_metadata(path, name)
    if failure:
        raise damaged(path / name, failure) from failure
    return values, newest["attributes"]


def list_arrays(path: Path) -> list[str]:
    """Return the names of all arrays but the cells, sorted."""
    names = {name for root in (path / COMMITTED, path) for name in _walk(root)}
    return sorted(names)


def _read_metadata(path: Path, name: str) -> dict[str, Any]:
    require(bool(NAME.fullmatch(name)), "name", "must be that of an array", repr(name), "see array_names", KeyError)
    try:
        metadata = read_newest(path, lambda folder: read_metadata(folder / name / METADATA))
    except FileNotFoundError:
        metadata = {"node_type": "none"}
    if metadata["node_type"] != "array" or name == CELLS:  # only then, as there may be very many of them
        names = list_arrays(path)
        require(False, "name", "must be that of an array", repr(name), f"{path} has {names}", KeyError)
    return metadata


def _read_values(path: Path, name: str, metadata: dict[str, Any]) -> NDArray:
    if 0 in metadata["shape"]:
        return np.zeros(metadata["shape"], metadata["data_type"])
    try:
        return open_array(path / COMMITTED / name, metadata).read().result()
    except ValueError as error:
        if not is_missing(error):
            raise
    return open_array(path / name, metadata).read().result()


def _walk(root: Path) -> Iterator[str]:
    for folder, folders, files in os.walk(root):
        name = os.path.relpath(folder, root)
        folders[:] = [part for part in folders if not part.startswith(".") and part != _CHUNKS]
        if name == ".":
            folders[:] = [part for part in folders if part != CELLS]
        elif METADATA in files and _is_array(Path(folder, METADATA)):
            yield name


def _is_array(file: Path) -> bool:
    try:
        return read_metadata(file)["node_type"] == "array"
    except FileNotFoundError:  # a commit has just moved it
        return True
