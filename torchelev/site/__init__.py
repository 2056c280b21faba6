"""A world map that grows: it merges the maps of many robots, is kept on disk, and initialises robots' maps.

Robot-centric windows live in `torchelev.elevation_map`, single files of maps in `torchelev.io`.
"""

from torchelev.site.fusion.merge import MergeReport
from torchelev.site.keyframes.keyframes import Keyframes
from torchelev.site.rasters.raster_site import RasterReport
from torchelev.site.shared.ranks import LostRankError
from torchelev.site.site_config import SiteConfig
from torchelev.site.site_map import SiteMap
from torchelev.site.storage.interface import Version
from torchelev.site.storage.versioned.repository import StoreError, UncertainCommitError

__all__ = [
    "Keyframes",
    "LostRankError",
    "MergeReport",
    "RasterReport",
    "SiteConfig",
    "SiteMap",
    "StoreError",
    "UncertainCommitError",
    "Version",
]
