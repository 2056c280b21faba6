#!/usr/bin/env bash
# VDBFusion 0.1.6: does integrate(points, pose) take a 4 x 4 pose with points of the sensor's frame?
#
# A sensor 1 m above flat ground is pitched down by 90 degrees: it looks along its own x axis at the ground.
# Expected: points of the sensor's frame and the sensor's pose give ground at z = 0.
# Seen: of the pose, its translation alone is used, as the origin of the rays. The points are taken as they are, without
# a word, so the surface is the wall x = 1 m of the sensor's frame. Points in the map's frame give ground at z = 0:
# transform them, and give the pose or its translation.
#
# Exits 0 while that holds. Installs into a temporary folder, 150 MB; needs Python 3.10, as later ones have no wheel.
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
"${PYTHON:-python3.10}" -m venv "$folder/venv"
"$folder/venv/bin/pip" install --quiet --disable-pip-version-check vdbfusion==0.1.6 numpy==1.26.4
"$folder/venv/bin/python" - <<'PYTHON'
import sys

import numpy as np
from vdbfusion import VDBVolume

y, z = (v.ravel() for v in np.meshgrid(np.arange(-0.5, 0.5, 0.02), np.arange(-0.5, 0.5, 0.02)))
in_sensor = np.stack([np.ones_like(y), y, z], -1)
pose = np.eye(4)
pose[:3, :3] = [[0, 0, 1], [0, 1, 0], [-1, 0, 0]]  # the sensor's x axis points down
pose[:3, 3] = [0, 0, 1]


def center_of_surface(points):
    volume = VDBVolume(0.05, 0.15)
    volume.integrate(np.ascontiguousarray(points), pose)
    vertices, _ = volume.extract_triangle_mesh(fill_holes=False, min_weight=0.5)
    return np.median(np.asarray(vertices), 0)


given, moved = center_of_surface(in_sensor), center_of_surface(in_sensor @ pose[:3, :3].T + pose[:3, 3])
print("middle of the surface, x y z [m]: from points of the sensor's frame", given.round(2), "of the map's", moved.round(2))
holds = abs(given[0] - 1) < 0.06 and abs(moved[2]) < 0.06 and abs(moved[0]) < 0.06
print("as before" if holds else "changed")
sys.exit(not holds)
PYTHON
