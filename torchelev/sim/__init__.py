"""Made-up worlds with known truth: scenes in closed form, exact ray casting, sensor noise, robot paths.

Needs torch only. Everything is float64 on the CPU inside; points come back as float32 in the sensor frame.
"""

from torchelev.sim.noise import dropout, noisy, outliers, range_noise
from torchelev.sim.scenes import Box, Scene
from torchelev.sim.sensors import DepthCamera, Lidar, cast
from torchelev.sim.trajectories import MOUNT, Trajectory, mount, sink, turn_on_the_spot, walk

__all__ = [
    "MOUNT", "Box", "DepthCamera", "Lidar", "Scene", "Trajectory", "cast", "dropout", "mount", "noisy", "outliers",
    "range_noise", "sink", "turn_on_the_spot", "walk",
]  # fmt: skip
