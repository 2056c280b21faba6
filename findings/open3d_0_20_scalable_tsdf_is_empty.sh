#!/usr/bin/env bash
# Open3D 0.19.0 and 0.20.0: does ScalableTSDFVolume integrate a depth image?
#
# A depth image of a wall 2 m ahead, of floats in metres and of 16 bits in millimetres, is integrated once with the
# camera at the origin, and the mesh of the volume is extracted.
# Expected: a mesh of the wall, with both versions.
# Seen: 0.19.0 returns 3,300 vertices for each. 0.20.0 returns none, raises nothing and prints nothing, with and without
# colour. create_from_depth_image of the same image gives all its points, and UniformTSDFVolume a mesh, with both. Maps
# made with the scalable volume of 0.20.0 are empty: pin 0.19.0, or use the uniform volume or t.geometry.VoxelBlockGrid.
#
# Exits 0 while that holds. Installs into a temporary folder, 2 x 1.2 GB; needs Python 3.10 to 3.12, and the system's
# libusb-1.0, libGL and libX11.
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
cat > "$folder/wall.py" <<'PYTHON'
import numpy as np
import open3d as o3d

tsdf = o3d.pipelines.integration
width, height = 160, 120
camera = o3d.camera.PinholeCameraIntrinsic(width, height, 96.0, 96.0, 79.5, 59.5)
black = o3d.geometry.Image(np.zeros((height, width, 3), np.uint8))
images = {
    "float": (o3d.geometry.Image(np.full((height, width), 2.0, np.float32)), 1.0),
    "uint16": (o3d.geometry.Image(np.full((height, width), 2000, np.uint16)), 1000.0),
}
for name, (image, scale) in images.items():
    rgbd = o3d.geometry.RGBDImage.create_from_color_and_depth(black, image, scale, 8.0, False)
    points = o3d.geometry.PointCloud.create_from_depth_image(rgbd.depth, camera, np.eye(4))
    found = [len(points.points)]
    for kind in (tsdf.TSDFVolumeColorType.NoColor, tsdf.TSDFVolumeColorType.RGB8):
        volume = tsdf.ScalableTSDFVolume(0.05, 0.2, kind)
        volume.integrate(rgbd, camera, np.eye(4))
        found.append(len(volume.extract_triangle_mesh().vertices))
    uniform = tsdf.UniformTSDFVolume(8.0, 160, 0.2, tsdf.TSDFVolumeColorType.RGB8, np.full(3, -4.0))
    uniform.integrate(rgbd, camera, np.eye(4))
    found.append(len(uniform.extract_triangle_mesh().vertices))
    print(name, *found)
PYTHON
for version in 0.19.0 0.20.0; do
    python3 -m venv "$folder/$version"
    "$folder/$version/bin/pip" install --quiet "open3d==$version"
    "$folder/$version/bin/python" "$folder/wall.py" | tee "$folder/$version.txt"
done
check() { awk -v want="$2" '{ ok = $2 == 19200 && $5 > 1000 && (want ? $3 > 1000 && $4 > 1000 : $3 + $4 == 0) }
    !ok { bad = 1 } END { exit bad || NR != 2 }' "$folder/$1.txt"; }
check 0.19.0 1 && check 0.20.0 0 && echo "as described"
