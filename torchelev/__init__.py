"""torchelev: batched, differentiable elevation mapping in PyTorch, for robots that learn."""

from __future__ import annotations

from typing import TYPE_CHECKING

from torchelev.lazy_names import import_later

if TYPE_CHECKING:
    from torchelev.channels.config import ChannelConfig
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
    from torchelev.stages.compensate.config import DriftConfig, InlierConfig
    from torchelev.stages.fusion.config import AveragingConfig, EdgeConfig, FusionConfig
    from torchelev.stages.measure.config import BodyConfig, DepthConfig, ExclusionConfig, SensorConfig
    from torchelev.stages.overlap.config import OverlapConfig, SquareConfig
    from torchelev.stages.surface.config import SurfaceConfig, UpperBoundConfig
    from torchelev.stages.visibility.config import RaycastConfig, SteppingConfig
    from torchelev.state import MapState, Measurement, Statistics
    from torchelev.traversability.heads import LearnedTraversabilityConfig, TraversabilityConfig
    from torchelev.traversability.net import TraversabilityNet

__version__ = "0.1.0"
__all__ = [
    "AgingConfig",
    "AveragingConfig",
    "BodyConfig",
    "Box",
    "Capsule",
    "ChannelConfig",
    "DepthConfig",
    "DriftConfig",
    "EdgeConfig",
    "ElevationMap",
    "ElevationMapConfig",
    "ExclusionConfig",
    "FilterConfig",
    "FusionConfig",
    "GridConfig",
    "HeightScan",
    "InlierConfig",
    "LearnedTraversabilityConfig",
    "LevelsConfig",
    "MapImage",
    "MapState",
    "Measurement",
    "OverlapConfig",
    "RaycastConfig",
    "RobotBody",
    "RobotConfig",
    "SensorConfig",
    "SquareConfig",
    "Statistics",
    "SteppingConfig",
    "SurfaceConfig",
    "TraversabilityConfig",
    "TraversabilityNet",
    "UpperBoundConfig",
    "depth_to_points",
    "voxel_filter",
]

# Imported when first asked for: a robot's node may run without PyTorch, and not every map needs them all.
_LATER = {
    "AgingConfig": "torchelev.stages.age.config",
    "AveragingConfig": "torchelev.stages.fusion.config",
    "BodyConfig": "torchelev.stages.measure.config",
    "Box": "torchelev.robot_body.shapes",
    "Capsule": "torchelev.robot_body.shapes",
    "ChannelConfig": "torchelev.channels.config",
    "DepthConfig": "torchelev.stages.measure.config",
    "DriftConfig": "torchelev.stages.compensate.config",
    "EdgeConfig": "torchelev.stages.fusion.config",
    "ElevationMap": "torchelev.elevation_map",
    "ElevationMapConfig": "torchelev.config",
    "ExclusionConfig": "torchelev.stages.measure.config",
    "FilterConfig": "torchelev.filters.chain",
    "FusionConfig": "torchelev.stages.fusion.config",
    "GridConfig": "torchelev.grid",
    "HeightScan": "torchelev.observations.height_scan",
    "InlierConfig": "torchelev.stages.compensate.config",
    "LearnedTraversabilityConfig": "torchelev.traversability.heads",
    "LevelsConfig": "torchelev.levels.config",
    "MapImage": "torchelev.observations.map_image",
    "MapState": "torchelev.state",
    "Measurement": "torchelev.state",
    "OverlapConfig": "torchelev.stages.overlap.config",
    "RaycastConfig": "torchelev.stages.visibility.config",
    "RobotBody": "torchelev.robot_body.shapes",
    "RobotConfig": "torchelev.robot",
    "SensorConfig": "torchelev.stages.measure.config",
    "SquareConfig": "torchelev.stages.overlap.config",
    "Statistics": "torchelev.state",
    "SteppingConfig": "torchelev.stages.visibility.config",
    "SurfaceConfig": "torchelev.stages.surface.config",
    "TraversabilityConfig": "torchelev.traversability.heads",
    "TraversabilityNet": "torchelev.traversability.net",
    "UpperBoundConfig": "torchelev.stages.surface.config",
    "depth_to_points": "torchelev.inputs.clouds",
    "voxel_filter": "torchelev.inputs.clouds",
}
__getattr__, __dir__ = import_later(__name__, _LATER)
