"""A robot's body from MJCF or URDF, read by MuJoCo, and the poses of its links from MuJoCo's data."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from torch import Tensor

from torchelev.errors import require
from torchelev.frames import transform
from torchelev.io.models.shapes import robot_geoms
from torchelev.io.models.urdf import load_urdf, parse_urdf
from torchelev.robot_body.shapes import Box, Capsule, RobotBody

if TYPE_CHECKING:
    from jaxtyping import Float
    from numpy.typing import NDArray


def read_body(source: Any, links: Iterable[str] | None = None, **options: float) -> RobotBody:
    """Read a robot's shapes from an MJCF or URDF file.

    All shapes of bodies that move count, whether they collide or not; of MJCF, meshes that do not collide are pictures,
    and count only on links without other shapes or with much smaller ones. Of URDF, a link's <visual> counts if it has
    no <collision>, and meshes are looked for in its package, beside the file and in the folders above it.

    Spheres, capsules and boxes are taken as they are. A cylinder becomes the capsule that holds it, or a box if it is
    flatter than wide; an ellipsoid or a mesh becomes the box around it, along the axes of its inertia. Shapes of bodies
    that do not move against their parent are fixed to the parent's link. The floor and other bodies of the world are
    left out.

    Args:
        source: path of the file; or a `mujoco.MjModel` or `mujoco.MjSpec`. Give the path of a URDF file: MuJoCo itself
            drops the name of its base.
        links: names of the links to take; None: all that move, and the base that carries them.
        options: `padding` and `depth_tolerance` of the `RobotBody`.

    Returns:
        The body. Its `links` are the order in which an update takes the poses, see `link_poses`.

    Raises:
        ImportError: if MuJoCo is missing.
        ValueError: if MuJoCo cannot read the file, a mesh is missing, the file is xacro, there is no such link, or it
            has no shape.

    Warns:
        UserWarning: visual meshes of links without collision shapes are missing, and left out; names the links.
    """
    links = _check_names(links)
    model = _load(source, links)
    names = [model.body(k).name for k in range(model.nbody)]
    wanted = None if links is None else _check_links(links, names)
    capsules: list[Capsule] = []
    boxes: list[Box] = []
    found: set[str] = set()
    for geom in robot_geoms(model, lambda body: _link_of(model, body), lambda *of: _pose_in_link(model, *of)):
        body, link = int(model.geom_bodyid[geom]), _link_of(model, int(model.geom_bodyid[geom]))
        if wanted is not None and not wanted & {names[body], names[link]}:
            continue
        found |= {names[body], names[link]}
        hint = "give its body a name in the model"
        require(names[link] != "", "source", "must name the bodies of its shapes", f"body {link} without a name", hint)
        shape = _shape(model, geom, names[link], _pose_in_link(model, geom, link))
        if isinstance(shape, Capsule):
            capsules.append(shape)
        else:
            boxes.append(shape)
    without = sorted((wanted or set()) - found)
    hint = "leave them out: they take no room that the model knows of"
    require(not without, "links", "must have shapes", f"none of {', '.join(without)}", hint)
    hint = "give it geoms, and its base a joint: bodies that never move belong to the world"
    require(bool(found), "source", "must have shapes on links that move", "none", hint)
    return RobotBody(capsules=tuple(capsules), boxes=tuple(boxes), **options)


def link_poses(model: Any, data: Any, body: RobotBody, base: str | None = None) -> Float[Tensor, "*B K 4 4"]:
    """Return T_base_links, the poses of the body's links in the base frame, from MuJoCo's.

    Args:
        model: the `mujoco.MjModel`, which knows the bodies' names.
        data: `mujoco.MjData` after `mj_forward` or `mj_kinematics`; or anything with `xpos` (..., nbody, 3) [m] and
            `xquat` (..., nbody, 4), arrays or tensors, such as the data of many environments.
        body: what `read_body` returned.
        base: name of the body whose pose is `T_map_base`; None: the root of the first link's tree.

    Returns:
        (..., K, 4, 4) in the dtype and on the device of `data`, in the order of `body.links`.

    Raises:
        ValueError: if the model lacks a link or the base.
    """
    names = {model.body(k).name: k for k in range(model.nbody)}
    _check_links([*body.links, *([] if base is None else [base])], list(names))
    ids = [names[link] for link in body.links]
    root = int(model.body_rootid[ids[0]]) if base is None else names[base]
    position, quat = torch.as_tensor(data.xpos), torch.as_tensor(data.xquat)
    chosen = [torch.stack([value[..., k, :] for k in (root, *ids)], -2) for value in (position, quat)]
    T = transform(*chosen)
    to_base = T[..., :1, :3, :3].mT
    T_base_links = T[..., 1:, :, :].clone()
    T_base_links[..., :3, :3] = to_base @ T[..., 1:, :3, :3]
    T_base_links[..., :3, 3] = (to_base @ (T[..., 1:, :3, 3] - T[..., :1, :3, 3])[..., None])[..., 0]
    return T_base_links


def _load(source: Any, links: tuple[str, ...] | None) -> Any:
    """Return the MjModel of a file or spec, with the bodies that do not move against their parent kept apart."""
    try:
        import mujoco
    except ImportError as error:
        raise ImportError("read_body: needs MuJoCo to read robot models; install it with pip install mujoco") from error
    if isinstance(source, mujoco.MjModel):
        return source
    is_path = isinstance(source, str | Path)
    hint = "give the path of an MJCF or URDF file"
    fits = is_path or isinstance(source, mujoco.MjSpec)
    require(fits, "source", "must be a path, an MjModel or an MjSpec", type(source).__name__, hint, TypeError)
    if isinstance(source, mujoco.MjSpec):
        return source.copy().compile()
    require(Path(source).is_file(), "source", "must be an MJCF or URDF file", str(source), "check the path")
    urdf = parse_urdf(Path(source))
    try:
        if urdf is not None:
            return load_urdf(Path(source), urdf, links)
        spec = mujoco.MjSpec.from_file(str(source))
        spec.compiler.fusestatic = False  # a base of URDF that it includes stays apart from the world
        return spec.compile()
    except ValueError as error:
        text = " ".join(str(error).split())
        if text.startswith("source: "):
            raise
        hint = "open it in MuJoCo's viewer: python -m mujoco.viewer --mjcf=FILE"
        if "opening file" in text or "resource" in text:
            hint = "copy its meshes and textures to where the model names them, or set meshdir"
        require(False, "source", "must be a model that MuJoCo reads", f"{source}: {text}", hint)


def _check_names(links: Iterable[str] | None) -> tuple[str, ...] | None:
    hint = "give names such as ('base', 'FL_thigh'), or None"
    require(not isinstance(links, str), "links", "must be a tuple of names", repr(links), hint)
    return None if links is None else tuple(links)


def _check_links(links: Iterable[str], names: list[str]) -> set[str]:
    """Return the names as a set; ValueError for those that the model lacks."""
    wanted = set(links)
    unknown = sorted(wanted - set(names[1:]))
    hint = f"there are {', '.join(name for name in names[1:] if name)}"
    require(not unknown, "links", "must be bodies of the model", ", ".join(unknown), hint)
    return wanted


def _link_of(model: Any, body: int) -> int:
    """Return the body that a body is fixed to: the next one up its tree that moves, or the tree's root."""
    while model.body_jntnum[body] == 0 and model.body_parentid[body] != 0:
        body = int(model.body_parentid[body])
    return body


def _matrix(position: NDArray, quat_wxyz: NDArray) -> NDArray[np.float64]:
    return transform(position, quat_wxyz).numpy()


def _pose_in_link(model: Any, geom: int, link: int) -> NDArray[np.float64]:
    """Return T_link_geom (4, 4), along the bodies between that do not move."""
    T, body = _matrix(model.geom_pos[geom], model.geom_quat[geom]), int(model.geom_bodyid[geom])
    while body != link:
        T = _matrix(model.body_pos[body], model.body_quat[body]) @ T
        body = int(model.body_parentid[body])
    return T


def _shape(model: Any, geom: int, link: str, T_link_geom: NDArray[np.float64]) -> Capsule | Box:
    """Return a geom as a shape that holds it."""
    import mujoco

    kind, size, aabb = mujoco.mjtGeom(int(model.geom_type[geom])), model.geom_size[geom], model.geom_aabb[geom]
    radius, half = float(size[0]), float(size[1])
    is_rod = kind == mujoco.mjtGeom.mjGEOM_CYLINDER and half >= radius
    if kind == mujoco.mjtGeom.mjGEOM_SPHERE:
        half = 0.0
    elif kind != mujoco.mjtGeom.mjGEOM_CAPSULE and not is_rod:
        return _box(link, T_link_geom, aabb[:3], aabb[3:])
    start, end = ((T_link_geom @ (0.0, 0.0, side * half, 1.0))[:3] for side in (-1.0, 1.0))
    return Capsule(link=link, start=tuple(start), end=tuple(end), radius=radius)


def _box(link: str, T_link_geom: NDArray[np.float64], center: NDArray, half_lengths: NDArray) -> Box:
    """Return the box along a geom's axes."""
    import mujoco

    quat = np.zeros(4)
    mujoco.mju_mat2Quat(quat, T_link_geom[:3, :3].ravel())
    w, x, y, z = quat.tolist()
    position = tuple((T_link_geom @ [*center, 1.0])[:3])
    half_lengths = np.maximum(half_lengths, 1e-4)  # of a flat mesh, one is zero
    return Box(link=link, center=position, half_lengths=tuple(half_lengths), quat_wxyz=(w, x, y, z))
