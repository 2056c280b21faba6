"""Simulated worlds with known ground truth, to test maps in and to train policies in. Needs torch only.

For one robot, exact: scenes in closed form (`exact/`), with sensors that see them to below 0.1 mm, noise and
trajectories. They compute in float64 on the CPU; points are returned as float32 in the sensor frame.

For many robots, fast: height fields, courses and structures of boxes (`terrains/`), mounted sensors that cast rays at
them (`sensors/`), and errors of sensors and poses that each environment draws for itself (`errors/`). They compute in
float32 on any device. Environments that robots act in are not here: see `envs/`.
"""

from torchelev.sim.boxes import Boxes
from torchelev.sim.errors.error_models import SensorErrorConfig, SensorErrors
from torchelev.sim.errors.pose_error import PoseErrorConfig, PoseErrors
from torchelev.sim.errors.presets import ErrorPreset, preset
from torchelev.sim.exact.noise import dropout, noisy, outliers, range_noise
from torchelev.sim.exact.scenes import Box, Scene
from torchelev.sim.exact.sensors import DepthCamera, Lidar, NonRepetitiveLidar, cast
from torchelev.sim.exact.trajectories import Trajectory, sink, turn_on_the_spot, walk
from torchelev.sim.poses import MOUNT, mount, mount_on_rim
from torchelev.sim.sensors.mounted import MountedSensor
from torchelev.sim.terrains.course import Course, CourseConfig, make_course
from torchelev.sim.terrains.covers import CoversConfig
from torchelev.sim.terrains.generate import Terrain, TerrainGrid, make_terrain, terrain_grid
from torchelev.sim.terrains.heightfield import HeightField
from torchelev.sim.terrains.parts import Part
from torchelev.sim.terrains.structures import Structures
from torchelev.sim.terrains.surfaces import surface_of

__all__ = [
    "MOUNT", "Box", "Boxes", "Course", "CourseConfig", "CoversConfig", "DepthCamera", "ErrorPreset", "HeightField",
    "Lidar", "MountedSensor", "NonRepetitiveLidar", "Part", "PoseErrorConfig", "PoseErrors", "Scene",
    "SensorErrorConfig", "SensorErrors", "Structures", "Terrain", "TerrainGrid", "Trajectory", "cast", "dropout",
    "make_course", "make_terrain", "mount", "mount_on_rim", "noisy", "outliers", "preset", "range_noise", "sink",
    "surface_of", "terrain_grid", "turn_on_the_spot", "walk",
]  # fmt: skip
