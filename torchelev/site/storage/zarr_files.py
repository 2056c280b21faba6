"""Zarr 3 groups and arrays of a site: their metadata, and how tensorstore opens them."""

from __future__ import annotations

import errno
import json
import os
import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from torchelev.errors import require

METADATA = "zarr.json"
ATTRIBUTES_HINT = "give JSON values; convert tensors and NumPy's numbers with .tolist(), and replace NaN by None"
TILES_PER_AXIS = 2**18  # absent ones cost nothing; at 64 cells of 0.1 m they span 1,700 km

_OS_ERROR_CODE = re.compile(r"os_error_code='(\d+)'|OS error (\d+)")
_KINDS = "biuf"  # bool, int, uint, float


def group_metadata(attributes: Mapping[str, Any]) -> dict[str, Any]:
    """Return the metadata of a group."""
    return {"zarr_format": 3, "node_type": "group", "attributes": dict(attributes)}


def cells_metadata(num_layers: int, tile_size: int) -> dict[str, Any]:
    """Return the metadata of the array of all cells, (L, N, N) with N = TILES_PER_AXIS * tile_size, a file per tile."""
    cells = TILES_PER_AXIS * tile_size
    shape, chunk = [num_layers, cells, cells], [num_layers, tile_size, tile_size]
    return _array(shape, chunk, "float32", "NaN", {}, "/") | {"dimension_names": ["layer", "x", "y"]}


def array_metadata(array: NDArray, attributes: Mapping[str, Any]) -> dict[str, Any]:
    """Return the metadata of an array that is stored as one file; its numbers must be of a kind that Zarr 3 has."""
    name = require_storable(array)
    fill_value = {"b": False, "f": "NaN"}.get(array.dtype.kind, 0)
    chunk = [max(1, size) for size in array.shape]
    # The file lies in the array's own folder: making and removing further ones takes longer than writing it.
    return _array(list(array.shape), chunk, name, fill_value, dict(attributes), ".")


def require_storable(array: NDArray) -> str:
    """Return the name of an array's type; ValueError unless Zarr 3 has it."""
    name = array.dtype.newbyteorder("=").name
    is_storable = array.dtype.kind in _KINDS and name != "float128"
    require(is_storable, "arrays", "must hold bools or numbers", name, "convert them")
    return name


def _array(
    shape: list[int], chunk: list[int], dtype: str, fill_value: object, attributes: dict, separator: str
) -> dict[str, Any]:
    return {
        "zarr_format": 3,
        "node_type": "array",
        "shape": shape,
        "data_type": dtype,
        "chunk_grid": {"name": "regular", "configuration": {"chunk_shape": chunk}},
        "chunk_key_encoding": {"name": "default", "configuration": {"separator": separator}},
        "fill_value": fill_value,
        "codecs": _codecs(np.dtype(dtype).itemsize),
        "attributes": attributes,
    }


def _codecs(itemsize: int) -> list[dict[str, Any]]:
    """Of 289 tiles, 33 MB, lz4 leaves 14 MB in 35 ms of one core; zstd at level 1 leaves 13 MB in 52 ms."""
    blosc = {"cname": "lz4", "clevel": 5, "shuffle": "shuffle", "typesize": itemsize, "blocksize": 0}
    return [
        {"name": "bytes", "configuration": {"endian": "little"}},
        {"name": "blosc", "configuration": blosc},
        {"name": "crc32c"},  # finds changed bits; blosc would return other numbers
    ]


def open_array(folder: Path, metadata: dict[str, Any]) -> Any:
    """Return the `tensorstore.TensorStore` of an array. Nothing is cached, and its folder need not exist yet.

    Raises:
        ModuleNotFoundError: tensorstore is missing.
        ValueError: the metadata are damaged.
    """
    tensorstore = import_tensorstore()
    spec = {
        "driver": "zarr3",
        "kvstore": {"driver": "file", "path": f"{folder.absolute()}/"},
        "metadata": metadata,
        "store_data_equal_to_fill_value": True,  # a tile without known cells replaces an older one
        "fill_missing_data_reads": False,
    }
    # The commit point is one rename; waiting for the disk at each file would take longer than all else.
    context = tensorstore.Context({"file_io_sync": False})
    try:
        return tensorstore.open(spec, open=True, assume_metadata=True, context=context).result()
    except ValueError as error:
        raise damaged(folder / METADATA, error) from error


def import_tensorstore() -> Any:
    """Import tensorstore, or raise ModuleNotFoundError that says how to install it."""
    try:
        import tensorstore
    except ModuleNotFoundError as error:
        if error.name != "tensorstore":
            raise
        raise ModuleNotFoundError('sites need tensorstore: pip install "torchelev[site]"', name=error.name) from error
    return tensorstore


def wait_for(writes: Sequence[Any]) -> None:
    """Wait for all futures of tensorstore's writes; raise OSError if one failed."""
    try:
        errors = [error for error in [write.exception() for write in writes] if error is not None]
    except BaseException:  # Ctrl-C: a write that continues would end up in the next commit
        for write in writes:
            write.exception()
        raise
    if errors:
        found = _OS_ERROR_CODE.search(str(errors[0]))
        code = int(found[1] or found[2]) if found else errno.EIO
        raise OSError(code, os.strerror(code) if found else " ".join(str(errors[0]).split())) from errors[0]


def is_missing(error: ValueError) -> bool:
    """Return whether tensorstore raised this because a chunk's file is not there."""
    return str(error).startswith("NOT_FOUND")


def read_metadata(file: Path) -> dict[str, Any]:
    """Read a `zarr.json`.

    Raises:
        FileNotFoundError: there is none.
        ValueError: it is damaged.
    """
    try:
        metadata = json.loads(file.read_bytes())
    except ValueError as error:
        raise damaged(file, error) from error
    is_valid = isinstance(metadata, dict) and isinstance(metadata.setdefault("attributes", {}), dict)
    if not is_valid or metadata.get("node_type") not in ("array", "group"):
        raise damaged(file, ValueError("not the metadata of Zarr 3"))
    return metadata


def encode_metadata(metadata: dict[str, Any]) -> bytes:
    """Return the bytes of a `zarr.json`; raise ValueError unless its attributes can be written as JSON."""
    return encode_json(metadata, indent=1).encode()


def encode_json(attributes: Mapping[str, Any], indent: int | None = None) -> str:
    """Return attributes as JSON; raise ValueError if they cannot be written so."""
    try:
        return json.dumps(attributes, indent=indent, allow_nan=False)
    except (TypeError, ValueError) as error:
        raise ValueError(f"attributes: must be JSON, got a value for which {error}; {ATTRIBUTES_HINT}") from error


def write_metadata(file: Path, metadata: dict[str, Any]) -> None:
    """Write a `zarr.json` and the folders above it."""
    encoded = encode_metadata(metadata)
    file.parent.mkdir(parents=True, exist_ok=True)
    file.write_bytes(encoded)


def damaged(file: Path | str, error: Exception, what: str = "") -> ValueError:
    """Return the error for a file that cannot be read; `what` names what it holds."""
    reason = " ".join(str(error).split()) or type(error).__name__
    where = f"{file} ({what})" if what else str(file)
    return ValueError(f"{where}: must be readable, got damaged data: {reason}; restore it from a backup")
