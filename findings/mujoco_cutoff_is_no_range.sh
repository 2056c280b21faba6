#!/usr/bin/env bash
# MuJoCo 4.0.0: does the cutoff of mj_multiRay, and of a rangefinder sensor, end a ray as the range of a lidar does?
#
# A sensor 1 m above a ground plane looks at a ball 11.7 m away, at the ground 12.04 m away, at the ground 2.24 m away, and
# at a wall of 60 m that is 19.9 m away. The cutoff is 8 m.
# Expected: what is farther than 8 m is a miss, -1, for both, so that the cutoff can stand for a lidar's range.
# Seen: mj_multiRay with cutoff 8 misses the ball, but returns the ground at 12.04 m and the wall at 19.9 m: planes, and
# geoms whose bounding sphere begins within the cutoff, are hit at any distance. A rangefinder with cutoff="8" that looks
# at the ground at 12.04 m returns 8.0, which reads as a wall at the limit. So compare distances with the range yourself,
# and leave the sensor's cutoff out.
#
# Exits 0 while that holds. Installs into a temporary folder, 100 MB.
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
"${PYTHON:-python3.11}" -m venv "$folder/venv"
"$folder/venv/bin/pip" install --quiet --disable-pip-version-check mujoco==4.0.0 numpy==2.4.6
"$folder/venv/bin/python" - <<'PYTHON'
import sys

import mujoco
import numpy as np

SCENE = """
<mujoco>
  <worldbody>
    <geom type="plane" size="50 50 1"/>
    <geom name="wall" type="box" pos="0 20 1" size="30 0.1 1"/>
    <geom name="ball" type="sphere" pos="12 0 1" size="0.3"/>
    <body pos="0 0 1"><site name="eye" zaxis="12 0 -1"/></body>
  </worldbody>
  <sensor><rangefinder site="eye" cutoff="8"/></sensor>
</mujoco>
"""
TARGETS = {"ball": (1, 0, 0), "far ground": (12, 0, -1), "near ground": (2, 0, -1), "wall": (0, 1, 0)}

model = mujoco.MjModel.from_xml_string(SCENE)
data = mujoco.MjData(model)
mujoco.mj_forward(model, data)
rays = np.array(list(TARGETS.values()), float)
rays /= np.linalg.norm(rays, axis=1, keepdims=True)
geom, distance = np.zeros(len(rays), np.int32), np.zeros(len(rays))
eye = np.array([0.0, 0.0, 1.0])
mujoco.mj_multiRay(model, data, eye, rays.ravel(), None, 1, -1, geom, distance, None, len(rays), 8.0)
for name, value in zip(TARGETS, distance):
    print(f"mj_multiRay with cutoff 8 m, {name}: {value:.2f} m")
print(f"rangefinder with cutoff 8 m, far ground: {data.sensordata[0]:.2f} m")
seen = np.allclose(distance, [-1.0, np.sqrt(145), np.sqrt(5), 19.9], atol=0.01) and abs(data.sensordata[0] - 8.0) < 1e-9
sys.exit(0 if seen else 1)
PYTHON
