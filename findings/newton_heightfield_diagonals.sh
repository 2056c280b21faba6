#!/usr/bin/env bash
# Newton 1.8.0 (warp-lang 1.19.0, CPU): do rays and contacts meet the same surface of a height field?
#
# One cell of 1 m with two opposite corners at 1 m and the other two at 0. The two triangles of the cell share either the
# ridge between the raised corners, so that the middle is at 1 m, or the valley between the others: the middle is at 0 m.
# Expected: newton.intersect_ray and CollisionPipeline.collide agree on the height of the middle, so that a simulated
# depth sensor or height scanner measures the ground on which the robot stands.
# Seen: the ray hits the middle at 0.00 m, while a ball with a radius of 1 cm already touches with its centre at 0.80 m and
# has its contact point at 1.00 m when its centre is there: rays split each cell along one diagonal, contacts along the
# other. With the corners swapped it is the other way round. On rough ground both surfaces differ by up to the relief
# within a cell.
#
# Exits 0 while that holds. Installs into a temporary folder, 0.6 GB; the kernels compile for two minutes.
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
"${PYTHON:-python3.11}" -m venv "$folder/venv"
"$folder/venv/bin/pip" install --quiet --disable-pip-version-check newton==1.8.0 warp-lang==1.19.0 numpy==2.4.6
export WARP_CACHE_PATH="$folder/cache"
"$folder/venv/bin/python" - <<'PYTHON'
import sys

import newton
import numpy as np
import warp as wp

wp.config.quiet = True
RADIUS = 0.01


def middle(corners):
    """Return the height [m] of the middle of a cell as a ray sees it, and of the highest ball that touches it."""
    heights = newton.Heightfield(np.array(corners), 2, 2, hx=0.5, hy=0.5, min_z=0.0, max_z=1.0)
    builder = newton.ModelBuilder()
    builder.add_shape_heightfield(heightfield=heights)
    body = builder.add_body(xform=wp.transform(wp.vec3(0.0, 0.0, 5.0), wp.quat_identity()))
    builder.add_shape_sphere(body, radius=RADIUS)
    model = builder.finalize(device="cpu")
    state, pipeline = model.state(), newton.CollisionPipeline(model)
    contacts = pipeline.contacts()

    distance = wp.zeros(1, dtype=float, device="cpu")
    newton.intersect_ray(
        model,
        ray_origins=wp.array([[0.0, 0.0, 3.0]], dtype=wp.vec3, device="cpu"),
        ray_directions=wp.array([[0.0, 0.0, -1.0]], dtype=wp.vec3, device="cpu"),
        ray_worlds=wp.array([-1], dtype=wp.int32, device="cpu"),
        out_dist=distance,
    )

    def overlaps(z):
        poses = state.body_q.numpy()
        poses[0, :3] = 0.0, 0.0, z
        state.body_q.assign(poses)
        pipeline.collide(state, contacts)
        count = int(contacts.rigid_contact_count.numpy()[0])
        on_ground, in_ball = (getattr(contacts, f"rigid_contact_point{k}").numpy()[:count] for k in (0, 1))
        normal = contacts.rigid_contact_normal.numpy()[:count]
        gap = ((in_ball + (0.0, 0.0, z) - on_ground) * normal).sum(1)
        return bool((gap < RADIUS).any())

    touched = max(z for z in np.arange(-0.05, 1.2, 0.01) if overlaps(z))
    return 3.0 - float(distance.numpy()[0]), touched


ridge, valley = middle([[1.0, 0.0], [0.0, 1.0]]), middle([[0.0, 1.0], [1.0, 0.0]])
for name, (ray, ball) in (("raised corners (0, 0) and (1, 1)", ridge), ("raised corners (0, 1) and (1, 0)", valley)):
    print(f"{name}: the ray sees the middle at {ray:.2f} m, the ball touches it from {ball:.2f} m")
holds = abs(ridge[0]) < 0.01 and ridge[1] > 0.95 and abs(valley[0] - 1.0) < 0.01 and valley[1] < 0.05
sys.exit(0 if holds else 1)
PYTHON
