"""torchelev: batched, differentiable elevation mapping in PyTorch, for robots that learn."""

from torchelev.aging import AgingConfig
from torchelev.config import ElevationMapConfig
from torchelev.drift import DriftConfig
from torchelev.elevation_map import ElevationMap
from torchelev.filters.chain import FilterConfig
from torchelev.fusion import EdgeConfig, FusionConfig
from torchelev.grid import GridConfig
from torchelev.map_image import MapImage
from torchelev.overlap import OverlapConfig
from torchelev.raycast import RaycastConfig
from torchelev.robot import RobotConfig
from torchelev.scan import HeightScan
from torchelev.sensor import BodyConfig, ExclusionConfig, SensorConfig, depth_to_points, voxel_filter
from torchelev.state import MapState, Measurement, Statistics
from torchelev.surface import SurfaceConfig
from torchelev.traversability import LearnedTraversabilityConfig, TraversabilityConfig
from torchelev.traversability_net import TraversabilityNet

__version__ = "0.1.0"
__all__ = [
    "AgingConfig",
    "BodyConfig",
    "DriftConfig",
    "EdgeConfig",
    "ElevationMap",
    "ElevationMapConfig",
    "ExclusionConfig",
    "FilterConfig",
    "FusionConfig",
    "GridConfig",
    "HeightScan",
    "LearnedTraversabilityConfig",
    "MapImage",
    "MapState",
    "Measurement",
    "OverlapConfig",
    "RaycastConfig",
    "RobotConfig",
    "SensorConfig",
    "Statistics",
    "SurfaceConfig",
    "TraversabilityConfig",
    "TraversabilityNet",
    "depth_to_points",
    "voxel_filter",
]
