"""The help text of `torchelev map`."""

MAP_HELP = """Build an elevation map from RECORDING, a folder of scans with poses, or a bag.

A bag is a file .bag (ROS 1), .mcap or .db3 (ROS 2), or a folder of them. Topics
and frames are found automatically unless they are ambiguous; `torchelev bag`
lists them.

\b
  torchelev map drive.mcap
  torchelev map drive.mcap --points /lidar/points \\
      --map-frame odom --base-frame base_link

A folder, or its subfolder scans/, holds one file per scan. File names set the
order; numbers in them count by value, so 2 comes before 10. Maps written there
earlier are ignored.

\b
Point clouds, in metres, in the sensor frame:
  .bin (KITTI: float32 x y z intensity)  .npy  .npz  .ply  .pcd
Depth images, with --intrinsics:
  .png (uint16), .npy or .npz (floats in metres, or uint16); integers are
  millimetres unless --depth-scale or the intrinsics say otherwise

If the points have times (a field t, time, timestamp, ... or a column of
seconds) and the poses have times or --dt is given, the motion within each scan
is removed.

The pose file has one line per scan: the sensor's pose in a map frame whose
z axis points up. A line holds 12 numbers (KITTI: the upper 3x4 of the pose
matrix, row by row) or 8 numbers (TUM: t x y z qx qy qz qw); an index may stand
before them. The poses of the KITTI odometry benchmark are the camera's: with
its calib.txt beside the poses or the scans, they are converted to the lidar's.

\b
Example: a folder drive/ with scans/000000.bin, ... and poses.txt
  torchelev map drive
  torchelev map drive/scans --poses drive/poses.txt \\
      --resolution 0.05 --size 30 --device cuda --out maps/drive

Some formats do not define their layout: specify it with --bin-layout,
--quaternions, --time-unit and --pcd-frame. Files that contradict the layout in
use are rejected.

\b
Output files:
  PREFIX.npz  every layer with its geometry, for NumPy
  PREFIX.png  a picture of the main layers
  PREFIX.ply  a mesh for MeshLab, CloudCompare or Blender

The map is a window that follows the sensor and forgets what leaves it. To keep
the whole area, use --fixed with a larger --size.

\b
All other settings go into a YAML file, grouped by stage; see --config:
  sensor: {min_distance: 0.8}    # [m] ignore returns from the robot itself
  drift: null                    # turn height-drift compensation off
"""
