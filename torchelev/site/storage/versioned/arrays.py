"""Arrays that a repository holds beside its cells, such as keyframes."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from torchelev.errors import require
from torchelev.site.storage.named_arrays import NAME
from torchelev.site.storage.site_header import CELLS
from torchelev.site.storage.versioned.chunks import codecs
from torchelev.site.storage.zarr_files import require_storable


def write_array(store: Any, name: str, array: NDArray, attributes: Mapping[str, Any]) -> None:
    """Write an array as one chunk, in place of an earlier one."""
    import zarr

    array = np.asarray(array)
    require_storable(array)
    zarr.create_array(
        store,
        name=name,
        data=np.ascontiguousarray(array, array.dtype.newbyteorder("=")),
        chunks=tuple(max(1, size) for size in array.shape) or "auto",
        compressors=codecs(),
        attributes=dict(attributes),
        overwrite=True,
    )


def read_array(store: Any, name: str) -> tuple[NDArray, dict[str, Any]]:
    """Read an array and its attributes; KeyError if there is none of this name."""
    import zarr

    is_name = NAME.fullmatch(name) is not None and name != CELLS
    require(is_name, "name", "must be that of an array", repr(name), "see array_names", KeyError)
    try:
        array = zarr.open_array(store, path=name, mode="r")
    except (FileNotFoundError, zarr.errors.ContainsGroupError) as error:
        raise KeyError(f"name: must be that of an array, got {name!r}; see array_names") from error
    return np.asarray(array[...]), dict(array.attrs)


def list_arrays(store: Any) -> list[str]:
    """Return the sorted names of all arrays but the cells."""
    import zarr

    members = zarr.open_group(store, mode="r").members(max_depth=None)
    return sorted(name for name, member in members if isinstance(member, zarr.Array) and name != CELLS)
