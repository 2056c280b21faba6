"""The C library from Python: built or loaded, and one of its maps as an object."""

from __future__ import annotations

import ctypes
import functools
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from torchelev.errors import require
from torchelev.runtime.structures import COUNT, POINTER, STATISTICS, Input, Limits, Statistics


class LibraryError(ValueError):
    """What the C library refused, in its own sentence. `status` is its `torchelev_status`."""

    def __init__(self, status: int, text: str) -> None:
        super().__init__(text)
        self.status = status


def build_library() -> ctypes.CDLL:
    """Return the library of this checkout or wheel, built for this machine if need be.

    Raises:
        RuntimeError: there is no C++ compiler, or TORCHELEV_NATIVE=0 forbids to build.
    """
    from torchelev.kernels.cpu_build import load

    library = load(*library_parts())
    if library is None:
        raise RuntimeError("libtorchelev: no C++ compiler was found, or TORCHELEV_NATIVE=0; install g++ or clang++")
    return _declared(library)


def library_parts() -> tuple[tuple[str, ...], dict[str, str], dict[str, str]]:
    """Return sources, constants and headers of the library."""
    from torchelev.runtime.generate import headers  # which asks Python's declarations, and so needs PyTorch
    from torchelev.runtime.sources import SOURCES

    return SOURCES, {"TORCHELEV_VERSION": '"' + _version() + '"'}, headers()


def open_library(path: str | Path) -> ctypes.CDLL:
    """Return a library that was built elsewhere, such as by CMake.

    Raises:
        ValueError: it cannot be loaded, or is no libtorchelev.
    """
    try:
        return _declared(ctypes.CDLL(str(path)))
    except (OSError, AttributeError) as error:
        raise ValueError(f"{path}: no libtorchelev of this machine ({error})") from error


def _version() -> str:
    from torchelev import __version__

    return __version__


def _declared(library: ctypes.CDLL) -> ctypes.CDLL:
    for name in ("torchelev_last_error", "torchelev_version", "torchelev_map_link_name"):
        getattr(library, name).restype = ctypes.c_char_p
    library.torchelev_map_tensor.restype = POINTER
    library.torchelev_scan_size.restype = library.torchelev_scan_num_feet.restype = COUNT
    return library


def _text(value: str) -> ctypes.c_char_p:
    return ctypes.c_char_p(value.encode())


def _address(array: NDArray | None) -> int | None:
    return None if array is None else array.ctypes.data


def _array(name: str, value: Any, dtype: Any, shape: tuple[int, ...]) -> Any:
    """Return a value as an array of this dtype and shape, in which -1 is any size; None stays None."""
    if value is None:
        return None
    array = np.ascontiguousarray(value, dtype)
    fits = array.ndim == len(shape) and all(b in (-1, a) for a, b in zip(array.shape, shape, strict=True))
    require(fits, name, f"expected {shape}", array.shape, "see torchelev.h")
    return array


class CMap:
    """A map of the C library: `torchelev.h`.

    Args:
        library: what `build_library` or `open_library` returned.
        config: path of a config file, or its text if that contains a brace.
        max_points: of all sensors of one update.
        max_sensors: of one update.
        num_threads: that share an update.

    Raises:
        LibraryError: the library refuses the config.
    """

    def __init__(
        self,
        library: ctypes.CDLL,
        config: str | Path,
        max_points: int = 131072,
        max_sensors: int = 4,
        num_threads: int = 1,
    ) -> None:
        self._library, self._map = library, POINTER()
        create = "create_from_text" if "{" in str(config) else "create"
        limits = Limits(max_points, max_sensors, num_threads)
        self._call(f"torchelev_map_{create}", _text(str(config)), ctypes.byref(limits), ctypes.byref(self._map))

    def __del__(self) -> None:
        if self._map:
            self._library.torchelev_map_free(self._map)

    def _call(self, name: str, *arguments: Any) -> None:
        status = getattr(self._library, name)(*arguments)
        if status:
            raise LibraryError(status, self._library.torchelev_last_error().decode())

    @functools.cached_property
    def size(self) -> tuple[int, int]:
        """H and W."""
        rows, columns = COUNT(), COUNT()
        self._call("torchelev_map_size", self._map, ctypes.byref(rows), ctypes.byref(columns), None)
        return rows.value, columns.value

    def update(
        self,
        points: Any,
        T_map_sensor: Any,
        T_map_base: Any = None,
        dt: float = 0.0,
        variance: Any = None,
        pose_covariance: Any = None,
        T_base_links: Any = None,
    ) -> None:
        """Update by points (S, N, 3), poses (S, 4, 4), (4, 4), (K, 4, 4), variance (S, N) and covariance (S, 6, 6)."""
        points = _array("points", points, np.float32, (-1, -1, 3))
        S, N = points.shape[:2]
        poses = [
            _array("T_map_sensor", T_map_sensor, np.float64, (S, 4, 4)),
            _array("T_map_base", T_map_base, np.float64, (4, 4)),
            _array("T_base_links", T_base_links, np.float64, (len(self.links) or -1, 4, 4)),
        ]
        variance = _array("variance", variance, np.float32, (S, N))
        covariance = _array("pose_covariance", pose_covariance, np.float64, (S, 6, 6))
        addresses = (_address(value) for value in (points, *poses))
        entry = Input(S, N, *addresses, dt, _address(variance), _address(covariance))
        self._call("torchelev_map_update", self._map, ctypes.byref(entry))

    @property
    def links(self) -> list[str]:
        """Names of the K links whose poses updates take."""
        name = self._library.torchelev_map_link_name
        return [name(self._map, k).decode() for k in range(self._library.torchelev_map_num_links(self._map))]

    def move(self, T_map_base: Any) -> None:
        """Move the window to the robot."""
        pose = _array("T_map_base", T_map_base, np.float64, (4, 4))
        self._call("torchelev_map_move", self._map, POINTER(_address(pose)))

    def reset(self) -> None:
        """Forget everything."""
        self._call("torchelev_map_reset", self._map)

    def initialize(self, feet: Any, method: str = "linear") -> None:
        """Estimate the unknown cells from ground points (K, 3) [m]."""
        feet = _array("feet", feet, np.float64, (-1, 3))
        self._call("torchelev_map_initialize", self._map, POINTER(_address(feet)), COUNT(len(feet)), _text(method))

    def clear_around(self, center: Any, radius: float) -> None:
        """Forget the cells within a radius [m] of a place (2,) [m]."""
        center = _array("center", center, np.float64, (2,))
        self._call("torchelev_map_clear_around", self._map, POINTER(_address(center)), ctypes.c_double(radius))

    def layer(self, name: str) -> NDArray:
        """Return a layer (H, W), NaN where not known."""
        values = np.empty(self.size, np.float32)
        address = POINTER(_address(values))
        self._call("torchelev_map_layer", self._map, _text(name), address, ctypes.c_size_t(values.size))
        return values

    def tensor(self, name: str, dtype: Any) -> NDArray:
        """Return a copy of a tensor of the state, flat."""
        size = ctypes.c_size_t()
        address = self._library.torchelev_map_tensor(self._map, _text(name), ctypes.byref(size))
        if not address:
            raise LibraryError(1, self._library.torchelev_last_error().decode())
        return np.frombuffer(ctypes.string_at(address, size.value), dtype)

    def sample(self, name: str, xy: Any, mode: str = "bilinear") -> tuple[NDArray, NDArray]:
        """Return a layer's values at points (M, 2) [m], and where they are known."""
        xy = _array("xy", xy, np.float64, (-1, 2))
        values, known = np.empty(len(xy), np.float32), np.empty(len(xy), bool)
        places = (POINTER(_address(array)) for array in (values, known))
        at = POINTER(_address(xy)), COUNT(len(xy))
        self._call("torchelev_map_sample", self._map, _text(name), _text(mode), *at, *places)
        return values, known

    @property
    def corner(self) -> tuple[float, float]:
        """Position [m] of the window's corner with the smallest x and y."""
        corner = (ctypes.c_double * 2)()
        self._call("torchelev_map_corner", self._map, corner)
        return corner[0], corner[1]

    @functools.cached_property
    def resolution(self) -> float:
        """Side of a cell [m]."""
        side = ctypes.c_double()
        self._call("torchelev_map_size", self._map, None, None, ctypes.byref(side))
        return side.value

    def statistics(self) -> dict[str, float]:
        """Return what the last update did, by name."""
        found = Statistics()
        self._call("torchelev_map_statistics", self._map, ctypes.byref(found))
        return {name: getattr(found, name) for name in STATISTICS}

    def diagnose(self) -> list[str]:
        """Return what looks wrong with the inputs, a sentence each."""
        text = ctypes.c_char_p()
        self._call("torchelev_map_diagnose", self._map, ctypes.byref(text))
        return (text.value or b"").decode().splitlines()

    def save(self, path: str | Path) -> None:
        """Save the whole map."""
        self._call("torchelev_map_save", self._map, _text(str(path)))

    def load(self, path: str | Path) -> None:
        """Load a map that was saved."""
        self._call("torchelev_map_load", self._map, _text(str(path)))

    def scan(self, layout: str) -> CScan:
        """Return a height scan by the name of a preset, or by a layout as JSON."""
        return CScan(self, layout)

    def image(self, settings: str) -> CImage:
        """Return an image by its settings as JSON."""
        return CImage(self, settings)


class _Reader:
    """What reads a map of the C library: an object of the kind "scan" or "image"."""

    kind: str

    def __init__(self, emap: CMap, settings: str) -> None:
        self._library, self._handle, self._emap = emap._library, POINTER(), emap
        emap._call(f"torchelev_{self.kind}_create", emap._map, _text(settings), ctypes.byref(self._handle))

    def __del__(self) -> None:
        if self._handle:
            getattr(self._library, f"torchelev_{self.kind}_free")(self._handle)

    def _read(self, *arrays: NDArray | None) -> None:
        places = (POINTER(_address(array)) for array in arrays)
        self._emap._call(f"torchelev_{self.kind}_read", self._handle, self._emap._map, *places)


class CScan(_Reader):
    """A height scan of the C library."""

    kind = "scan"

    def __call__(self, T_map_base: Any, feet: Any = None) -> tuple[NDArray, NDArray]:
        """Return values (P), and where the elevation is known."""
        size = self._library.torchelev_scan_size(self._handle)
        num_feet = self._library.torchelev_scan_num_feet(self._handle)
        pose = _array("T_map_base", T_map_base, np.float64, (4, 4))
        feet = _array("feet", feet, np.float64, (num_feet or -1, 3))
        values, known = np.empty(size, np.float32), np.empty(size, bool)
        self._read(pose, feet, values, known)
        return values, known


class CImage(_Reader):
    """An image of the C library."""

    kind = "image"

    def __call__(self, T_map_base: Any) -> NDArray:
        """Return the image (C, H, W)."""
        shape = (COUNT * 3)()
        self._emap._call("torchelev_image_shape", self._handle, shape)
        pose, values = _array("T_map_base", T_map_base, np.float64, (4, 4)), np.empty(tuple(shape), np.float32)
        self._read(pose, values)
        return values
