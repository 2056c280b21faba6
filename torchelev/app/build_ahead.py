"""Build the C++ libraries that a wheel carries: `make wheel`, or `python -m torchelev.app.build_ahead`."""

from __future__ import annotations

import shutil

from torchelev.channels.native import LIBRARY as CHANNELS
from torchelev.channels.views import LIBRARY as VIEWS
from torchelev.config import ElevationMapConfig
from torchelev.kernels.cpu_build import AHEAD, build_ahead
from torchelev.kernels.cpu_update import compiled_stages
from torchelev.kernels.registry import PACKAGE
from torchelev.observations.image_kernel import LIBRARY as IMAGES
from torchelev.observations.scan.kernel import LIBRARY as SCANS
from torchelev.observations.voxel_kernel import LIBRARY as VOXELS
from torchelev.pipeline import register_stages
from torchelev.planning.solvers.dijkstra import LIBRARY as DIJKSTRA
from torchelev.robot_body.own_kernel import LIBRARY as OWN_POINTS
from torchelev.runtime.library import library_parts
from torchelev.sim.errors.cloud_kernel import LIBRARY as ERRORS
from torchelev.sim.sensors.casting_kernel import LIBRARY as CASTING
from torchelev.sim.terrains.heights_kernel import LIBRARY as HEIGHTS

INCLUDE = PACKAGE / "runtime" / "include"


def main() -> None:
    """Build all libraries for each instruction set of this machine's kind."""
    shutil.rmtree(AHEAD, ignore_errors=True)
    stages = compiled_stages(register_stages(ElevationMapConfig())).parts
    others = (CASTING, CHANNELS, DIJKSTRA, ERRORS, HEIGHTS, IMAGES, OWN_POINTS, SCANS, VIEWS, VOXELS)
    for library in (stages, *others, library_parts()):
        for path in build_ahead(*library):
            print(path.name)
    for name in ("torchelev.h", "torchelev.hpp"):
        shutil.copy(INCLUDE / name, AHEAD / name)  # beside the libtorchelev of each instruction set


if __name__ == "__main__":
    main()
