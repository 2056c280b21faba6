"""Planar regions of maps, with their polygons: `segment`, and what planners and controllers ask of the result."""

from torchelev.planes.regions import Foothold, Planes, Region, convex_region
from torchelev.planes.segmentation import PlaneConfig, segment

__all__ = ["Foothold", "PlaneConfig", "Planes", "Region", "convex_region", "segment"]
