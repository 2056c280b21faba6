"""torchelev with its default settings."""

import torch

from benchmarks.peers.peer import Array, Cells, Frame, Setup
from torchelev import ElevationMap, ElevationMapConfig, GridConfig

MARGIN = 4.0  # [m]


class Map:
    """A map around the robot, whose window covers the area that is compared where the walk ends."""

    TITLE, NEEDS, TAKES = "torchelev", "torchelev", "points"
    SETTINGS = "defaults: every stage, a window around the robot that covers the area where the walk ends"

    def __init__(self, setup: Setup) -> None:
        self.centers = torch.from_numpy(Cells(setup).centers())
        length_x, length_y = (setup.resolution * n + MARGIN for n in setup.cells)
        grid = GridConfig(resolution=setup.resolution, length_x=length_x, length_y=length_y)
        self.emap = ElevationMap(ElevationMapConfig(grid=grid))
        self.emap.warm_up(20_000)

    def update(self, frame: Frame) -> None:
        """Fuse the scan."""
        given = (torch.from_numpy(value)[None] for value in (frame.points, frame.T_map_sensor, frame.T_map_base))
        self.emap.update(*given, dt=frame.dt)

    def ground(self) -> "tuple[Array, Array | None]":
        """Return elevation and standard deviation."""
        xy = self.centers.flatten(0, 1)[None]
        (height, known), (variance, _) = (self.emap.sample(xy, name, "nearest") for name in ("elevation", "variance"))
        height = torch.where(known, height, torch.nan)
        return height.view(self.centers.shape[:2]).numpy(), variance.sqrt().view(self.centers.shape[:2]).numpy()
