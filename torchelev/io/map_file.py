"""A whole map in one file: every environment, and everything that the next update reads."""

from __future__ import annotations

import json
import zipfile
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from torchelev import checks
from torchelev.config import ElevationMapConfig
from torchelev.elevation_map import ElevationMap
from torchelev.errors import require
from torchelev.map_buffers import name_tensors, state_of
from torchelev.output_files import atomic_file
from torchelev.pipeline import rate_surface
from torchelev.state import MapState
from torchelev.traversability.net import TraversabilityNet

FORMAT, VERSION = "torchelev map", 2
NEW_LAYERS = {"has_normal", "rated", "challenger", "challenger_support"}  # since version 2
DTYPES = {str(dtype).removeprefix("torch."): dtype for dtype in checks.FLOATS}


def save_map(path: str | Path, emap: ElevationMap) -> None:
    """Write the whole map: all environments, the layers that only an update reads too, config and precision.

    The file is an `.npz` without pickled objects: `header` (JSON: format, version, dtype, config), each field of
    `MapState` by its name, and each of `Statistics` as `last_<name>`; NaN-free, as the map holds them; and the learned
    head's weights, if there is one, as `head_<name>`. Raises WriteError, an OSError, if the file cannot be written; an
    older one is whole then.
    """
    dtype = str(emap.elevation.dtype).removeprefix("torch.")
    header = {"format": FORMAT, "version": VERSION, "dtype": dtype, "config": emap.cfg.to_dict()}
    header |= {"head": None if emap.head is None else emap.head.config}
    arrays: dict[str, Any] = {name: as_array(value) for name, value in name_tensors(emap.state).items()}
    arrays |= {f"head_{name}": as_array(value) for name, value in _head(emap).items()}
    with atomic_file(path) as file:  # a file object: numpy appends .npz to names that lack it
        np.savez_compressed(file, header=np.array(json.dumps(header)), **arrays)


def load_map(
    path: str | Path, device: torch.device | str = "cpu", env_ids: Sequence[int] | Tensor | None = None
) -> ElevationMap:
    """Read what `save_map` wrote into a new map on any device; it goes on as the saved one would have.

    `env_ids` (K,): the environments to load, in this order, None for all; repeated ids give copies. To the bit the
    same on the device that the map was saved from, elsewhere up to that device's rounding.

    Raises ValueError for another file, a damaged one, one of a newer version, and ids out of range.
    """
    arrays = read_npz(path, "write it with save_map")
    header = _header(path, arrays)
    ids = _ids(env_ids, _num_envs(path, arrays))
    try:
        head = None if header.get("head") is None else TraversabilityNet(**header["head"]).requires_grad_(False)
        emap = ElevationMap(ElevationMapConfig.from_dict(header["config"]), len(ids), device, head=head)
    except (ValueError, TypeError, KeyError, AttributeError) as error:
        raise ValueError(f"{path}: {error}; a filter of your own must be registered before it is loaded") from error
    emap = emap.to(DTYPES[header["dtype"]])
    for name, value in _head(emap).items():
        found = _array(path, arrays, f"head_{name}", value, tuple(value.shape))
        value.copy_(torch.from_numpy(found))
    state = _state(path, arrays, emap.state, ids, header["version"])
    if header["version"] < VERSION:
        state = rate_surface(state, emap.cfg, None if emap.head is None else emap.head.weights)
    emap.load_state(state)
    return emap


def _head(emap: ElevationMap) -> dict[str, Tensor]:
    """Return the learned head's weights by name, if there is one."""
    return {} if emap.head is None else dict(emap.head.state_dict())


def as_array(value: Tensor) -> NDArray:
    """Return a tensor as a numpy array; bfloat16, which NumPy lacks, as float32, which holds its values exactly."""
    value = value.detach().cpu()
    return (value.float() if value.dtype == torch.bfloat16 else value).numpy()


def read_npz(path: str | Path, hint: str) -> dict[str, NDArray]:
    """Read every array of an `.npz`. Raises ValueError for another file and for one that is damaged."""
    with Path(path).open("rb") as file:
        require(zipfile.is_zipfile(file), str(path), "must be an .npz file", "another, or one cut short", hint)
        file.seek(0)
        try:
            with np.load(file, allow_pickle=False) as arrays:
                return {name: arrays[name] for name in arrays.files}
        except Exception as error:  # what zipfile, zlib and numpy raise depends on which byte is damaged
            reason = " ".join(str(error).split()) or type(error).__name__
            raise ValueError(f"{path}: damaged, or no .npz file ({reason}); {hint}") from error


def _header(path: str | Path, arrays: dict[str, NDArray]) -> dict[str, Any]:
    """Return the file's header, of a version that can be read."""
    try:
        header = json.loads(str(arrays["header"]))
    except (KeyError, json.JSONDecodeError):
        header = None
    ours = isinstance(header, dict) and header.get("format") == FORMAT and "config" in header
    hint = "write it with save_map; what save_npz wrote is read by load_npz"
    require(ours, str(path), "must be a whole map", f"an .npz with {', '.join(arrays) or 'nothing'}", hint)
    assert isinstance(header, dict)
    version = header.get("version")
    known = isinstance(version, int) and 1 <= version <= VERSION
    require(known, str(path), f"must be of format version 1 to {VERSION}", version, "read it with a newer torchelev")
    kinds = ", ".join(DTYPES)
    require(str(header.get("dtype")) in DTYPES, str(path), f"must be of {kinds}", header.get("dtype"), "save it again")
    return header


def _num_envs(path: str | Path, arrays: dict[str, NDArray]) -> int:
    corner = arrays.get("corner")
    fits = corner is not None and corner.ndim == 2 and len(corner) > 0
    require(fits, str(path), "must have a corner (B, 2)", "none", "save it again")
    assert corner is not None
    return len(corner)


def _ids(env_ids: Sequence[int] | Tensor | None, num_envs: int) -> Tensor:
    """Return the ids of the environments to load (K,), on the CPU."""
    ids = torch.arange(num_envs) if env_ids is None else torch.as_tensor(env_ids).cpu()
    whole = ids.ndim == 1 and len(ids) > 0 and not ids.is_floating_point() and ids.dtype != torch.bool
    require(whole, "env_ids", "must be a list of numbers", f"{tuple(ids.shape)} {ids.dtype}", "None loads all")
    checks.require_indices("env_ids", ids, num_envs, f"the file has {num_envs} environments")
    return ids.to(torch.int64)


def _state(path: str | Path, arrays: dict[str, NDArray], like: MapState, ids: Tensor, version: int) -> MapState:
    """Return the chosen environments of the arrays, each of the shape that it has in `like`.

    Layers that files of version 1 do not have are blank.
    """
    B, values = len(arrays["corner"]), {}
    for name, blank in name_tensors(like).items():
        if version < VERSION and name in NEW_LAYERS:
            values[name] = blank[:1].expand(len(ids), *blank.shape[1:])
            continue
        values[name] = torch.from_numpy(_array(path, arrays, name, blank, (B, *blank.shape[1:])))[ids]
    return state_of(values)


def _array(path: str | Path, arrays: dict[str, NDArray], name: str, like: Tensor, shape: tuple[int, ...]) -> NDArray:
    """Return an array of the file, which must have this shape, numbers of the kind in `like`."""
    require(name in arrays, str(path), f"must have {name}", "none", "save it again")
    array, where = arrays[name], f"{path}, {name}"
    require(array.shape == shape, where, f"expected {shape}", array.shape, "save it again")
    kind = "f" if like.is_floating_point() else {torch.bool: "b", torch.uint8: "u"}.get(like.dtype, "i")
    require(array.dtype.kind == kind, where, f"expected numbers of kind '{kind}'", array.dtype, "save it again")
    return array
