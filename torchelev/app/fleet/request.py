"""The arguments of `torchelev fleet`."""

from __future__ import annotations

import math
from dataclasses import dataclass
from importlib.util import find_spec
from pathlib import Path

from torchelev.app.fleet.explore import cells_per_coarse_cell
from torchelev.app.fleet.robots import CAMP_SPACING
from torchelev.app.fleet.world import make_camp
from torchelev.errors import require, require_count, require_positive, whole_cells
from torchelev.files.output_files import require_writable

_WINDOW = 8.0  # [m] side of each robot's map, about
_MAX_ROBOTS, _MAX_SIZE = 256, 150.0
_PICTURES = (".png", ".svg", ".pdf")
_FINEST, _COARSEST = 0.04, 0.25  # [m]


@dataclass(frozen=True, kw_only=True)
class FleetRequest:
    """Arguments of `torchelev fleet`; see its help.

    Raises:
        ValueError: a number is out of range.
    """

    robots: int = 16  #: number of robots
    size: float = 60.0  #: [m] side of the area
    resolution: float = 0.1  #: [m] side of a cell
    seconds: float = 120.0  #: [s] simulated time at most
    seed: int = 0  #: of terrain, noise and height errors
    out: Path = Path("fleet.png")  #: picture; the numbers lie beside it as .json
    site: Path | None = None  #: folder of the site map; None: a temporary one
    live: bool = False  #: show the site map in the browser
    service: bool | None = None  #: robots talk to a merger in another process; None: with `live` if that is installed
    host: str = "127.0.0.1"  #: address that the page listens on
    port: int = 8080  #: of the page

    def __post_init__(self) -> None:
        require_count("--robots", self.robots, "give 16")
        require(self.robots <= _MAX_ROBOTS, "--robots", f"must be at most {_MAX_ROBOTS}", self.robots, "give 16")
        require_positive(**{"--size": self.size, "--resolution": self.resolution})
        is_possible, rule = _FINEST <= self.resolution <= _COARSEST, f"must lie in [{_FINEST}, {_COARSEST}] m"
        require(is_possible, "--resolution", rule, f"{self.resolution:g}", "give 0.1")
        is_enough, rule = 0 < self.seconds < 1e5, "must be a positive number of seconds"
        require(is_enough, "--seconds", rule, f"{self.seconds:g}", "give 120")
        require_count("--seed", self.seed, "give 0", minimum=0)
        is_picture = self.out.suffix in _PICTURES
        require(is_picture, "--out", f"must end with {', '.join(_PICTURES)}", self.out.name, "give fleet.png")
        self._check_size()

    def _check_size(self) -> None:
        """Refuse an area in which the camp has no room, or whose border cuts through coarse cells."""
        smallest, rule = math.ceil(2 * self.camp_radius + 2.0), f"must hold the camp of {self.robots} robots"
        require(self.size >= smallest, "--size", rule, f"{self.size:g} m", f"give {smallest} or more, or fewer robots")
        require(self.size <= _MAX_SIZE, "--size", f"must be at most {_MAX_SIZE:g} m", f"{self.size:g}", "give 60")
        whole_cells("--size", self.size, 2 * self.coarse)

    @property
    def is_served(self) -> bool:
        """Whether the robots send their maps to a merger in another process."""
        if self.service is None:
            return self.live and find_spec("zenoh") is not None and find_spec("tensorstore") is not None
        return self.service

    @property
    def coarse(self) -> float:
        """Side of the coarse cells that paths lead through [m]."""
        return cells_per_coarse_cell(self.resolution) * self.resolution

    @property
    def window(self) -> float:
        """Side of each robot's map [m]."""
        return round(_WINDOW / self.resolution) * self.resolution

    @property
    def camp_radius(self) -> float:
        """Radius of the level ground that the robots start on [m]."""
        return float(make_camp(self.robots, CAMP_SPACING).norm(dim=1).max()) + 1.0

    @property
    def numbers(self) -> Path:
        """The file of the numbers."""
        return self.out.with_suffix(".json")

    def require_outputs(self) -> None:
        """Raise WriteError if the picture or the numbers cannot be written."""
        for path in (self.out, self.numbers):
            require_writable(path)
