#!/usr/bin/env bash
# MuJoCo Warp 4.0.0 (mujoco 4.0.0, warp-lang 1.19.0, CPU): in which unit does mujoco_warp.rays count along a ray?
#
# A pyramid of 0.5 m is a height field and a mesh, and beside it there is a box of 0.5 m. Four slanting rays are cast at
# each from 2 m above the top, with directions of length 1 and of length 2.
# Expected: as mj_multiRay does, the distance counts in lengths of the direction, so that origin + distance * direction is
# the point that was hit, whatever the shape.
# Seen: for the box, and for all shapes where a render context with bounding volumes is given, it does. Without a render
# context it does not on the height field, through which directions of length 2 pass down to its base at z = 0, nor on
# the mesh, which they do not hit at all. No error is raised. So normalise directions, and compare distances in metres.
#
# Exits 0 while that holds. Installs into a temporary folder, 0.6 GB; the kernels compile for a minute.
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
"${PYTHON:-python3.11}" -m venv "$folder/venv"
"$folder/venv/bin/pip" install --quiet --disable-pip-version-check \
    mujoco==4.0.0 mujoco-warp==4.0.0 warp-lang==1.19.0 numpy==2.4.6
export WARP_CACHE_PATH="$folder/cache"
"$folder/venv/bin/python" - <<'PYTHON'
import sys

import mujoco
import mujoco_warp
import numpy as np
import warp as wp

wp.config.quiet = True
AXIS = np.linspace(-1.0, 1.0, 21)
HEIGHTS = 0.5 * (1 - np.maximum(*np.abs(np.meshgrid(AXIS, AXIS))))
SLANT = np.array([0.3, 0.2, -1.0])
OFFSETS = np.array([[0.0, 0.0], [0.23, 0.11], [-0.41, 0.32], [0.52, -0.57]])


def make(shape):
    """Return a model with the pyramid, or with a box of its height."""
    spec = mujoco.MjSpec()
    world = spec.worldbody
    if shape == "height field":
        spec.add_hfield(name="hill", nrow=21, ncol=21, size=[1, 1, 0.5, 0.1], userdata=(HEIGHTS / 0.5).flatten().tolist())
        world.add_geom(type=mujoco.mjtGeom.mjGEOM_HFIELD, hfieldname="hill")
    elif shape == "mesh":
        x, y = np.meshgrid(AXIS, AXIS)
        corner = (np.arange(20)[:, None] * 21 + np.arange(20)).reshape(-1)
        faces = np.concatenate([corner[:, None] + (0, 1, 22), corner[:, None] + (0, 22, 21)])
        vertices = np.stack([x, y, HEIGHTS], -1)
        mesh = {"uservert": vertices.flatten().tolist(), "userface": faces.flatten().tolist()}
        spec.add_mesh(name="hill", inertia=mujoco.mjtMeshInertia.mjMESH_INERTIA_SHELL, **mesh)
        world.add_geom(type=mujoco.mjtGeom.mjGEOM_MESH, meshname="hill")
    else:
        world.add_geom(type=mujoco.mjtGeom.mjGEOM_BOX, size=[1, 1, 0.25], pos=[0, 0, 0.25])
    return spec.compile()


def cast(mj_model, length, with_context):
    """Return the heights at which rays from z = 2.5 m end [m], NaN for a miss."""
    mj_data = mujoco.MjData(mj_model)
    mujoco.mj_forward(mj_model, mj_data)
    model, data = mujoco_warp.put_model(mj_model), mujoco_warp.put_data(mj_model, mj_data, nworld=1)
    context = None
    if with_context:
        context = mujoco_warp.create_render_context(mj_model, 1)
        mujoco_warp.refit_bvh(model, data, context)
    N = len(OFFSETS)
    origins = np.concatenate([OFFSETS - 2.0 * SLANT[:2], np.full((N, 1), 2.5)], 1)
    directions = np.tile(length * SLANT / np.linalg.norm(SLANT), (N, 1))
    start, along = (wp.array(value[None], dtype=wp.vec3) for value in (origins, directions))
    distance, geom = wp.zeros((1, N), dtype=float), wp.zeros((1, N), dtype=int)
    groups, excluded = wp.types.vector(6, float)(-1.0), wp.array(np.full(N, -1), dtype=int)
    normal = wp.zeros((1, N), dtype=wp.vec3)
    mujoco_warp.rays(model, data, start, along, groups, True, excluded, distance, geom, normal, context)
    found = distance.numpy()[0]
    return np.where(found < 0, np.nan, 2.5 + found * directions[:, 2])


holds = True
for shape in ("box", "height field", "mesh"):
    mj_model = make(shape)
    for with_context in (False, True):
        unit, other = cast(mj_model, 1.0, with_context), cast(mj_model, 2.0, with_context)
        agree = np.allclose(unit, other, atol=1e-3)
        name = "with a render context" if with_context else "without"
        print(f"{shape}, {name}: length 1 ends at z = {unit.round(3)}, length 2 at {other.round(3)} m")
        holds &= agree == (with_context or shape == "box")
sys.exit(0 if holds else 1)
PYTHON
