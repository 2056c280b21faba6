"""Planar regions of maps: `segment` finds them with their polygons, and `Planes` answers planners and controllers.

The plane of a single window, as normals need it, is in `torchelev.plane_fit`.
"""

from torchelev.planes.regions import Foothold, Planes, Region, convex_region
from torchelev.planes.segmentation import PlaneConfig, segment

__all__ = ["Foothold", "PlaneConfig", "Planes", "Region", "convex_region", "segment"]
