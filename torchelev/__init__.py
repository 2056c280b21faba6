"""torchelev: batched, differentiable elevation mapping in PyTorch, for robots that learn."""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

from torchelev.completion.config import CompletionConfig
from torchelev.config import ElevationMapConfig
from torchelev.elevation_map import ElevationMap
from torchelev.grid import GridConfig
from torchelev.inputs.clouds import depth_to_points, voxel_filter
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

if TYPE_CHECKING:
    from torchelev.completion.net import CompletionNet
    from torchelev.filters.chain import FilterConfig
    from torchelev.observations.height_scan import HeightScan
    from torchelev.observations.map_image import MapImage
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

# Imported when first asked for, as not every map needs them: they take half of the time of `import torchelev`.
_LATER = {
    "CompletionNet": "torchelev.completion.net",
    "FilterConfig": "torchelev.filters.chain",
    "HeightScan": "torchelev.observations.height_scan",
    "MapImage": "torchelev.observations.map_image",
    "TraversabilityNet": "torchelev.traversability.net",
}
_ROOMS = ("filters", "observations")  # `torchelev.filters.gaussian` works without an import of its own


def __getattr__(name: str) -> Any:
    if name in _ROOMS:
        return importlib.import_module(f"torchelev.{name}")
    if name not in _LATER:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}", name=name)
    value = globals()[name] = getattr(importlib.import_module(_LATER[name]), name)
    return value


def __dir__() -> list[str]:
    return sorted({*globals(), *_LATER, *_ROOMS})
