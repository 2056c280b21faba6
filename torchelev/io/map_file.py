"""Save and load a whole map: all environments, with everything that the next update needs."""

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

from torchelev.config import ElevationMapConfig
from torchelev.elevation_map import ElevationMap
from torchelev.errors import require
from torchelev.files.config_files import split_off_completion
from torchelev.files.output_files import atomic_file
from torchelev.inputs import checks
from torchelev.maps.buffers import name_tensors, state_of
from torchelev.pipeline import rate
from torchelev.state import MapState, forget_cells
from torchelev.traversability.net import TraversabilityNet

FORMAT, VERSION = "torchelev map", 2
WHOLE = "map_"  # begins the names of the whole map's arrays in a file of save_npz, beside its layers
_NEW_LAYERS = {"has_normal", "rated", "challenger", "challenger_support"}  # absent from version 1
_OPTIONAL = {"pose_covariance", "elapsed", "last_disagreement"}  # absent from older files of both versions
_DTYPES = {str(dtype).removeprefix("torch."): dtype for dtype in checks.FLOATS}


def save_map(path: str | Path, emap: ElevationMap) -> None:
    """Write a whole map, with all environments, its config and its precision, as an `.npz` without pickled objects.

    The arrays are `header` (JSON: format, version, dtype, config), each field of `MapState` by its name, each field of
    `Statistics` as `last_<name>`, what channels and levels hold as `channels_<name>` and
    `levels_<name>`, and the weights of a learned head as `head_<name>`. As in the map's state, unknown cells have
    validity 0, not NaN.

    Args:
        path: the file to write, under this name as it is.
        emap: the map.

    Raises:
        WriteError: the file cannot be written; an existing one is left as it was.
    """
    with atomic_file(path) as file:  # a file object: numpy appends .npz to names that lack it
        np.savez_compressed(file, **map_arrays(emap))


def map_arrays(emap: ElevationMap, envs: slice = slice(None)) -> dict[str, Any]:
    """Return the arrays of `save_map` for some environments of a map."""
    dtype = str(emap.elevation.dtype).removeprefix("torch.")
    header = {"format": FORMAT, "version": VERSION, "dtype": dtype, "config": emap.cfg.to_dict()}
    header["head"] = None if emap.head is None else emap.head.config
    of_environments = {name: value[envs] for name, value in (name_tensors(emap.state) | _followers(emap)).items()}
    arrays = {name: as_array(value) for name, value in (of_environments | _weights(emap)).items()}
    return {"header": np.array(json.dumps(header)), **arrays}


def load_map(
    path: str | Path, device: torch.device | str = "cpu", env_ids: Sequence[int] | Tensor | None = None
) -> ElevationMap:
    """Read a file of `save_map` or `save_npz` into a new map, which continues where the saved one stopped.

    Updates then give the same bits on the device type that the map was saved from, and agree up to rounding on others.

    Args:
        path: the file.
        device: of the new map.
        env_ids: (K,) environments to load, in this order; repeated ids give copies. None: all.

    Returns:
        The map.

    Raises:
        ValueError: not such a file, or layers alone, a damaged file, one of a newer version, or ids out of range.
    """
    arrays = read_npz(path, "write it with save_map")
    if WHOLE + "header" in arrays:  # of save_npz
        arrays = {name.removeprefix(WHOLE): array for name, array in arrays.items() if name.startswith(WHOLE)}
    header = _header(path, arrays)
    ids = _ids(env_ids, _num_envs(path, arrays))
    try:
        settings, completes = split_off_completion(header["config"])
        sizes = header.get("head")
        head = None if sizes is None else TraversabilityNet(**sizes).requires_grad_(False)
        emap = ElevationMap(ElevationMapConfig.from_dict(settings), len(ids), device, head=head)
    except (ValueError, TypeError, KeyError, AttributeError) as error:
        raise ValueError(f"{path}: {error}; a filter of your own must be registered before it is loaded") from error
    emap = emap.to(_DTYPES[header["dtype"]])
    for name, value in _weights(emap).items():
        value.copy_(torch.from_numpy(_array(path, arrays, name, value, tuple(value.shape))))
    state = _state(path, arrays, emap.state, ids, header["version"])
    if header["version"] < VERSION:
        state = rate(state, emap.cfg, None if emap.head is None else emap.head.weights)
    if completes:  # such files mark cells that were filled by their support, and kept their bounds
        measured = forget_cells(state, state.validity & (state.support < 0))
        state = measured._replace(upper_bound=state.upper_bound, bounded=state.bounded)
    emap.load_state(state)
    B = len(arrays["corner"])
    for name, value in _followers(emap).items():
        value.copy_(torch.from_numpy(_array(path, arrays, name, value, (B, *value.shape[1:])))[ids])
    return emap


def _weights(emap: ElevationMap) -> dict[str, Tensor]:
    """Return the weights of the map's learned head by the names of their arrays."""
    weights = {} if emap.head is None else emap.head.state_dict()
    return {f"head_{name}": value for name, value in weights.items()}


def _followers(emap: ElevationMap) -> dict[str, Tensor]:
    """Return the buffers of the map's channels and levels by the names of their arrays."""
    parts = {name: part for name in ("channels", "levels") if (part := getattr(emap, name)) is not None}
    buffers = ((f"{name}_{key}", value) for name, part in parts.items() for key, value in part.named_buffers())
    return {name: value for name, value in buffers if not name.startswith("levels_last_")}


def as_array(value: Tensor) -> NDArray:
    """Copy a tensor to a NumPy array; bfloat16, which NumPy lacks, becomes float32 without loss."""
    value = value.detach().cpu()
    return (value.float() if value.dtype == torch.bfloat16 else value).numpy()


def read_npz(path: str | Path, hint: str) -> dict[str, NDArray]:
    """Read all arrays of an `.npz`; raise ValueError, ending with `hint`, for a damaged file or another format."""
    with Path(path).open("rb") as file:
        actual = "another format or a truncated file"
        require(zipfile.is_zipfile(file), str(path), "must be an .npz file", actual, hint)
        file.seek(0)
        try:
            with np.load(file, allow_pickle=False) as arrays:
                return {name: arrays[name] for name in arrays.files}
        except Exception as error:  # zipfile, zlib and NumPy raise all kinds, depending on the damaged byte
            reason = " ".join(str(error).split()) or type(error).__name__
            raise ValueError(f"{path}: damaged, or not an .npz file ({reason}); {hint}") from error


def _header(path: str | Path, arrays: dict[str, NDArray]) -> dict[str, Any]:
    """Return the header; raise ValueError if this is not a map or its version cannot be read."""
    try:
        header = json.loads(str(arrays["header"]))
    except (KeyError, json.JSONDecodeError):
        header = None
    is_map = isinstance(header, dict) and header.get("format") == FORMAT and "config" in header
    hint = "write it with save_map or save_npz, or read layers alone with load_npz"
    require(is_map, str(path), "must be a whole map", f"an .npz with {', '.join(arrays) or 'nothing'}", hint)
    assert isinstance(header, dict)
    version = header.get("version")
    is_readable = isinstance(version, int) and 1 <= version <= VERSION
    require(
        is_readable, str(path), f"must be of format version 1 to {VERSION}", version, "read it with a newer torchelev"
    )
    dtype, names = header.get("dtype"), ", ".join(_DTYPES)
    require(str(dtype) in _DTYPES, str(path), f"dtype must be one of {names}", dtype, "save it again")
    return header


def _num_envs(path: str | Path, arrays: dict[str, NDArray]) -> int:
    corner = arrays.get("corner")
    is_valid = corner is not None and corner.ndim == 2 and len(corner) > 0
    actual = "none" if corner is None else corner.shape
    require(is_valid, str(path), "must have an array corner (B, 2)", actual, "save it again")
    assert corner is not None
    return len(corner)


def _ids(env_ids: Sequence[int] | Tensor | None, num_envs: int) -> Tensor:
    """Return the environments to load, (K,) int64 on the CPU."""
    ids = torch.arange(num_envs) if env_ids is None else torch.as_tensor(env_ids).cpu()
    are_ids = ids.ndim == 1 and len(ids) > 0 and not ids.is_floating_point() and ids.dtype != torch.bool
    require(are_ids, "env_ids", "must be a list of ints", f"{tuple(ids.shape)} {ids.dtype}", "None loads all")
    checks.require_indices("env_ids", ids, num_envs, f"the file has {num_envs} environments")
    return ids.to(torch.int64)


def _state(path: str | Path, arrays: dict[str, NDArray], like: MapState, ids: Tensor, version: int) -> MapState:
    """Return the state of environments `ids` from a file's arrays; what older files lack is taken from `like`."""
    B, values = len(arrays["corner"]), {}
    for name, blank in name_tensors(like).items():
        if (version < VERSION and name in _NEW_LAYERS) or (name in _OPTIONAL and name not in arrays):
            values[name] = blank[:1].expand(len(ids), *blank.shape[1:])
            continue
        values[name] = torch.from_numpy(_array(path, arrays, name, blank, (B, *blank.shape[1:])))[ids]
    return state_of(values)


def _array(path: str | Path, arrays: dict[str, NDArray], name: str, like: Tensor, shape: tuple[int, ...]) -> NDArray:
    """Return an array of the file; it must have this shape and the kind of numbers that `like` has."""
    require(name in arrays, str(path), f"must have an array {name}", "none", "save it again")
    array, where = arrays[name], f"{path}, {name}"
    require(array.shape == shape, where, f"expected {shape}", array.shape, "save it again")
    kind = "f" if like.is_floating_point() else {torch.bool: "b", torch.uint8: "u"}.get(like.dtype, "i")
    require(array.dtype.kind == kind, where, f"expected numbers of kind '{kind}'", array.dtype, "save it again")
    return array
