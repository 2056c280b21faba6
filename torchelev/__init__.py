"""torchelev: batched, differentiable elevation mapping in PyTorch, for robots that learn."""

from torchelev.completion.config import CompletionConfig
from torchelev.completion.net import CompletionNet
from torchelev.config import ElevationMapConfig
from torchelev.elevation_map import ElevationMap
from torchelev.filters.chain import FilterConfig
from torchelev.grid import GridConfig
from torchelev.inputs.clouds import depth_to_points, voxel_filter
from torchelev.observations.height_scan import HeightScan
from torchelev.observations.map_image import MapImage
from torchelev.robot import RobotConfig
from torchelev.robot_body.shapes import Box, Capsule, RobotBody
from torchelev.stages.age.config import AgingConfig
from torchelev.stages.compensate.config import DriftConfig
from torchelev.stages.fusion.config import EdgeConfig, FusionConfig
from torchelev.stages.measure.config import BodyConfig, ExclusionConfig, SensorConfig
from torchelev.stages.overlap.config import OverlapConfig
from torchelev.stages.surface.config import SurfaceConfig
from torchelev.stages.visibility.config import RaycastConfig
from torchelev.state import MapState, Measurement, Statistics
from torchelev.traversability.heads import LearnedTraversabilityConfig, TraversabilityConfig
from torchelev.traversability.net import TraversabilityNet

__version__ = "0.1.0"
__all__ = [
    "AgingConfig",
    "BodyConfig",
    "Box",
    "Capsule",
    "CompletionConfig",
    "CompletionNet",
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
    "RobotBody",
    "RobotConfig",
    "SensorConfig",
    "Statistics",
    "SurfaceConfig",
    "TraversabilityConfig",
    "TraversabilityNet",
    "depth_to_points",
    "voxel_filter",
]
