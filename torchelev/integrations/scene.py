"""Find the parts of a simulator's scene that a term names, and refuse those that do not fit."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from torch import Tensor

from torchelev.errors import require

if TYPE_CHECKING:
    from jaxtyping import Float


def to_names(parameter: str, value: Any) -> tuple[str, ...]:
    """Return one name, or a list of names, as a tuple; a `SceneEntityCfg` counts by its `name`."""
    given = value if isinstance(value, Sequence) and not isinstance(value, str) else [value]
    names: tuple[Any, ...] = tuple(getattr(item, "name", item) for item in given)
    are_names = len(names) > 0 and all(isinstance(name, str) for name in names)
    hint = f"set params={{{parameter!r}: ...}} of the term"
    require(are_names, parameter, "must name a part of the scene, or several in a list", repr(value), hint, TypeError)
    return names


def find(scene: Any, parameter: str, name: str, there: Iterable[str]) -> Any:
    """Return the part of the scene with this name; ValueError if there is none."""
    known = sorted(there)
    hint = "correct the name, or add it to the scene"
    require(name in known, parameter, f"must be one of {', '.join(known) or 'none'}", repr(name), hint)
    return scene[name]


def require_one_origin(parameter: str, name: str, starts: Tensor) -> None:
    """Refuse a ray sensor whose rays (..., N, 3) [m] do not all start at one point.

    The map clears what lies between a sensor's origin and its hits, which parallel rays did not pass through.
    """
    spread = float((starts - starts[..., :1, :]).abs().max())
    rule = f"the rays of {name!r} must start at one point, as those of cameras and lidars do"
    hint = "give it a pinhole or lidar pattern; parallel rays from above see the ground through everything"
    require(spread < 1e-6, parameter, rule, f"starts that are up to {spread:.3g} m apart", hint)


def check_directions(directions: Float[Tensor, "N 3"]) -> Tensor:
    """Return directions of rays; ValueError unless they are unit vectors."""
    fits = directions.ndim == 2 and directions.shape[1] == 3
    require(fits, "directions", "must be vectors (N, 3)", tuple(directions.shape), "give one for each ray")
    require_unit("directions", "must be unit vectors", directions)
    return directions


def require_unit(parameter: str, rule: str, directions: Tensor) -> None:
    """Refuse directions (..., 3) that are no unit vectors, in whose lengths a simulator may count distances."""
    lengths = torch.linalg.vector_norm(directions.double(), dim=-1)
    actual = f"lengths from {float(lengths.min()):.3g} to {float(lengths.max()):.3g}"
    require(bool(((lengths - 1).abs() < 1e-4).all()), parameter, rule, actual, "divide them by their norms")


def own_geoms(model: Any, body: int) -> np.ndarray:
    """Return which geoms of a MuJoCo model belong to the tree of bodies that `body` is part of, (geoms,) bool."""
    return model.body_rootid[model.geom_bodyid] == model.body_rootid[body]


def require_plain_camera(parameter: str, name: str, model: Any, camera: int) -> None:
    """Refuse a camera of a MuJoCo model that is not a perspective one given by fovy."""
    size = [float(length) for length in model.cam_sensorsize[camera]]
    is_parallel = bool(getattr(model, "cam_projection", [0] * (camera + 1))[camera])
    rule, hint = f"{name!r} must be a perspective camera given by fovy", "leave out sensorsize and orthographic"
    actual = f"sensorsize {size}, orthographic={is_parallel}"
    require(not any(size) and not is_parallel, parameter, rule, actual, hint)


def pinhole(fovy: Float[Tensor, "*B"], width: int, height: int) -> Float[Tensor, "*B 3 3"]:
    """Return K [pixels] of vertical fields of view [deg]; the centre lies between the middle pixels."""
    focal = height / (2 * torch.tan(torch.deg2rad(fovy) / 2))
    K = torch.eye(3, dtype=focal.dtype, device=focal.device).expand(*focal.shape, 3, 3).clone()
    K[..., 0, 0] = K[..., 1, 1] = focal
    K[..., 0, 2], K[..., 1, 2] = (width - 1) / 2, (height - 1) / 2
    return K
