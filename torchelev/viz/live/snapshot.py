"""The content of one picture of the live view, copied from the map and its robot."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray

from torchelev.errors import require
from torchelev.io.export import SavedMap, take
from torchelev.layers import LAYERS
from torchelev.levels import LAYERS as LEVEL_LAYERS

if TYPE_CHECKING:
    from jaxtyping import Float

    from torchelev.elevation_map import ElevationMap

_MAX_POINTS = 20_000  # of a cloud, so that a page stays fluid
_NO_POINTS = np.zeros((0, 3))


BOUND, CEILING, CLOUD, SCAN, FRAMES, PATH, PLANES, PLAN = (
    "upper bound", "ceiling", "last cloud", "policy's scan", "frames", "path", "planes", "planned path"
)  # fmt: skip
#: What can be shown beside the surface, and whether it is at first.
PARTS = {BOUND: True, CEILING: True, CLOUD: False, SCAN: True, FRAMES: True, PATH: True, PLANES: False, PLAN: True}


class Snapshot(NamedTuple):
    """One map with its robot at one time. Points are in the map frame."""

    map: SavedMap  #: layers of one environment
    T_map_base: NDArray[np.float64] | None = None  #: (4, 4); None: unknown
    T_map_sensor: NDArray[np.float64] | None = None  #: (S, 4, 4); None: unknown
    cloud: NDArray[np.float64] = _NO_POINTS  #: (N, 3) [m] the last cloud
    scan: NDArray[np.float64] = _NO_POINTS  #: (M, 3) [m] points that a policy reads
    plan: NDArray[np.float64] = _NO_POINTS  #: (P, 3) [m] planned path
    time: float = 0.0  #: [s] since the start

    @property
    def parts(self) -> set[str]:
        """Names of `PARTS` that can be shown beside the surface."""
        robot = {FRAMES, PATH} if self.T_map_base is not None else {FRAMES} if self.T_map_sensor is not None else set()
        points = {CLOUD: self.cloud, SCAN: self.scan, PLAN: self.plan}
        ceilings = {CEILING} if "ceiling" in self.map.layers else set()
        return {BOUND, PLANES} | ceilings | robot | {name for name, values in points.items() if len(values)}

    @property
    def nbytes(self) -> int:
        """Memory [bytes] of the arrays."""
        return sum(values.nbytes for values in self.map.layers.values()) + self.cloud.nbytes


def take_snapshot(
    emap: ElevationMap,
    T_map_base: Float[Any, "*B 4 4"] | None = None,
    T_map_sensor: Float[Any, "*B 4 4"] | None = None,
    points: Float[Any, "*B N 3"] | None = None,
    *,
    env: int = 0,
    scan: Float[Any, "*B M 3"] | None = None,
    plan: Float[Any, "P 3"] | None = None,
    layers: tuple[str, ...] = (),
    time: float = 0.0,
) -> Snapshot:
    """Copy one environment and what surrounds it.

    Args:
        emap: the map.
        T_map_base: (B, 4, 4) or (4, 4) pose of the base; tensors or arrays, as are all others.
        T_map_sensor: (B, 4, 4), (B, S, 4, 4) or (4, 4) poses of the sensors.
        points: (B, N, 3), (B, S, N, 3) or (N, 3) [m] the last cloud, sensor frame.
        env: the environment.
        scan: (B, M, 2), such as `HeightScan.xy`, or (B, M, 3) [m] points that a policy reads, map frame. Without z
            they lie on the elevation, and are left out where that is unknown.
        plan: (P, 3) [m] planned path of this environment, map frame.
        layers: names of layers of filters and channels to show beside the map's own.
        time: [s] since the start.

    Raises:
        ValueError: the environment does not exist, or a shape differs.
    """
    B = emap.num_envs
    base = _pick("T_map_base", T_map_base, env, B, (4, 4), (2, 3))
    sensor = _pick("T_map_sensor", T_map_sensor, env, B, (4, 4), (2, 3, 4))
    cloud = _pick("points", points, env, B, (3,), (2, 3, 4))
    is_flat = scan is not None and tuple(np.shape(scan))[-1:] == (2,)
    policy = _pick("scan", scan, env, B, (2,) if is_flat else (3,), (2, 3))
    planned = _pick("plan", plan, env, B, (3,), (2,))
    own = (*LAYERS, *(() if emap.levels is None else LEVEL_LAYERS))
    saved = take(emap, env, (*own, *(name for name in layers if name not in own)))
    policy = _onto(saved, policy) if policy is not None and is_flat else policy
    return Snapshot(
        saved,
        base,
        None if sensor is None else sensor.reshape(-1, 4, 4),
        _NO_POINTS if cloud is None else _to_map_frame(cloud, sensor),
        _drop_unknown(policy),
        _drop_unknown(planned),
        time,
    )


def _pick(
    name: str, values: Any, env: int, num_envs: int, ending: tuple[int, ...], dims: tuple[int, ...]
) -> NDArray[np.float64] | None:
    """Return one environment's values, or the values as they are if they have no batch dimension, as arrays.

    Args:
        name: of the argument.
        values: (..., *ending) tensor or array.
        env: the environment.
        num_envs: B.
        ending: the last dimensions.
        dims: numbers of dimensions that are allowed; the lowest is without a batch.
    """
    if values is None:
        return None
    shape = tuple(np.shape(values))
    fits = len(shape) in dims and shape[-len(ending) :] == ending
    fits = fits and (len(shape) == dims[0] or shape[0] == num_envs)
    rule = f"expected ({num_envs}, ..., {', '.join(map(str, ending))}) with {' or '.join(map(str, dims))} dimensions"
    require(fits, name, rule, shape, "the first dimension is the environment's; leave it out for a single robot")
    return _to_numpy(values[env] if len(shape) > dims[0] else values)


def _to_numpy(values: Any) -> NDArray[np.float64]:
    return values.detach().double().cpu().numpy() if isinstance(values, torch.Tensor) else np.asarray(values, float)


def _drop_unknown(points: NDArray[np.float64] | None) -> NDArray[np.float64]:
    """Return the points (N, 3) that are finite."""
    return _NO_POINTS if points is None else points[np.isfinite(points).all(1)]


def _onto(saved: SavedMap, xy: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return points (M, 3) on the elevation of their cells, NaN where it is unknown."""
    i, j, is_inside = saved.find_cells(xy)
    return np.column_stack([xy, np.where(is_inside, saved.layers["elevation"][i, j], np.nan)])


def _to_map_frame(points: NDArray[np.float64], T: NDArray[np.float64] | None) -> NDArray[np.float64]:
    """Return at most `_MAX_POINTS` of the points of all sensors, map frame."""
    expected, actual = (1,) if points.ndim == 2 else points.shape[:1], None if T is None else T.shape
    rule = f"expected the poses of the {expected[0]} clouds of points"
    require(T is not None and (T.shape[:-2] or (1,)) == expected, "T_map_sensor", rule, actual, "give one for each")
    assert T is not None
    T, points = T.reshape(-1, 4, 4), points.reshape(*expected, -1, 3)
    points = points[:, :: max(1, -(-points.shape[0] * points.shape[1] // _MAX_POINTS))]
    return _drop_unknown((points @ T[:, :3, :3].swapaxes(1, 2) + T[:, None, :3, 3]).reshape(-1, 3))
