"""Made-up worlds with known truth, to test maps in and to train policies in. Needs torch only.

One robot, exact: scenes in closed form, sensors that see them to below 0.1 mm, noise, paths; float64 on the CPU inside,
points come back as float32 in the sensor frame.

Many robots, fast: terrains as height fields, mounted sensors whose rays are cast at them and at boxes, and errors of
sensors and poses that each environment draws for itself; float32 on any device.
"""

from torchelev.sim.casting import Boxes
from torchelev.sim.error_models import SensorErrorConfig, SensorErrors
from torchelev.sim.heightfield import HeightField
from torchelev.sim.mounted import MountedSensor
from torchelev.sim.noise import dropout, noisy, outliers, range_noise
from torchelev.sim.pose_error import PoseErrorConfig, PoseErrors
from torchelev.sim.presets import ErrorPreset, preset
from torchelev.sim.scenes import Box, Scene
from torchelev.sim.sensors import DepthCamera, Lidar, NonRepetitiveLidar, cast
from torchelev.sim.terrains import Terrain, TerrainGrid, make_terrain, terrain_grid
from torchelev.sim.trajectories import MOUNT, Trajectory, mount, sink, turn_on_the_spot, walk

__all__ = [
    "MOUNT", "Box", "Boxes", "DepthCamera", "ErrorPreset", "HeightField", "Lidar", "MountedSensor",
    "NonRepetitiveLidar", "PoseErrorConfig", "PoseErrors", "Scene", "SensorErrorConfig", "SensorErrors", "Terrain",
    "TerrainGrid", "Trajectory", "cast", "dropout", "make_terrain", "mount", "noisy", "outliers", "preset",
    "range_noise", "sink", "terrain_grid", "turn_on_the_spot", "walk",
]  # fmt: skip
