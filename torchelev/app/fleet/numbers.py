"""Accuracy and cost of a mission's site map, compared with the true terrain."""

from __future__ import annotations

from dataclasses import asdict, dataclass, field
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray

from torchelev.app.fleet.mission import Mission
from torchelev.app.results import align

if TYPE_CHECKING:
    from torchelev.io.export import SavedMap

_BLOCK = 1.0  # [m] side of the blocks whose errors are compared to find seams
_MIN_SHARE = 0.25  # of a block's cells that must be known and away from steps
_WARM_UP = 3  # updates and merges that the median times leave out


class Comparison(NamedTuple):
    """The site map of the area beside the truth, (H, W) each."""

    saved: SavedMap  #: the site map
    truth: NDArray  #: [m]
    error: NDArray  #: [m] without what all heights have in common; NaN where unknown
    is_step: NDArray  #: the cell is at a step, where a small error of its place is a large error of its height
    common_offset: float  #: [m] the site's heights above the true ones: only differences of heights are observable


@dataclass(frozen=True, kw_only=True)
class FleetNumbers:
    """Numbers of a mission. Errors leave out the offset that all heights have in common."""

    robots: int  #: number of robots
    seconds: float  #: [s] simulated
    walked: float  #: [m] by all robots together
    coverage: float  #: share of the area's cells that are known
    rmse: float  #: [m]
    rmse_off_steps: float  #: [m] without cells at steps
    seams: float  #: [m] 95th percentile of how much the mean errors of neighbouring blocks of 1 m differ
    common_offset: float  #: [m] of the site map
    height_error_span: float  #: [m] between the highest and the lowest height error of the robots' poses
    largest_offset_error: float  #: [m] by which the site misjudged a robot's height error
    contradictions: int  #: how often a robot contradicted the site or another robot at a cell, in all merges
    ms_per_update: float  #: [ms] median, all robots
    ms_per_merge: float  #: [ms] median, all robots
    num_bytes: int  #: of the site map on disk; 0: it is in memory
    wall_seconds: float  #: [s] the mission took
    #: per robot [m]: height error of its pose at the last merge, less the common offset, and that which the site found
    offsets: list[tuple[float, float]] = field(repr=False)
    history: list[tuple[float, float]] = field(repr=False)  #: time [s] and coverage of each merge

    def to_dict(self) -> dict[str, Any]:
        """Return the numbers for a JSON file."""
        return asdict(self)

    def __str__(self) -> str:
        rows = [
            ("simulated", f"{count_robots(self.robots)}, {self.seconds:.0f} s, {self.walked:.0f} m walked"),
            ("coverage", f"{100 * self.coverage:.1f} % of the area's cells"),
            ("RMSE", f"{_cm(self.rmse)}, {_cm(self.rmse_off_steps)} away from steps"),
            ("seams", f"{_cm(self.seams)} between neighbouring blocks of {_BLOCK:g} m (95th percentile)"),
            (
                "offsets",
                f"over {_cm(self.height_error_span)} between robots, found within {_cm(self.largest_offset_error)}",
            ),
            ("disagreed", f"{self.contradictions:,} times a cell, in {len(self.history)} merges"),
            ("update", f"{self.ms_per_update:.1f} ms (median, all robots)"),
            ("merge", f"{self.ms_per_merge:.1f} ms (median, all robots)"),
            ("on disk", f"{self.num_bytes / 1e6:.2f} MB" if self.num_bytes else "nothing: the site map is in memory"),
            ("took", f"{self.wall_seconds:.0f} s"),
        ]
        return "\n".join(align(rows))


def count_robots(number: int) -> str:
    """Return a number of robots in words."""
    return "1 robot" if number == 1 else f"{number} robots"


def _cm(metres: float) -> str:
    return f"{100 * metres:.2f} cm"


def compare(mission: Mission) -> Comparison:
    """Compare the area of the site map with the truth."""
    saved, resolution = mission.saved, mission.request.resolution
    assert saved is not None
    elevation = saved.layers["elevation"]
    xy = torch.as_tensor(_cell_centers(saved))
    truth = mission.world.truth(xy).numpy()
    error = elevation - truth
    common = float(np.nanmedian(error))
    return Comparison(saved, truth, error - common, mission.world.find_steps(xy, resolution).numpy(), common)


def _cell_centers(saved: SavedMap) -> NDArray[np.float64]:
    """Return the centres (H, W, 2) [m] of the cells."""
    shape = next(iter(saved.layers.values())).shape
    axes = [(np.arange(n) + 0.5 - n / 2) * saved.resolution + c for n, c in zip(shape, saved.center[:2], strict=True)]
    return np.stack(np.meshgrid(*axes, indexing="ij"), -1)


def assess(mission: Mission, comparison: Comparison, wall_seconds: float) -> FleetNumbers:
    """Return the numbers of a mission that has merged at least once."""
    smooth = np.where(comparison.is_step, np.nan, comparison.error)
    found = np.asarray(mission.report.offsets.cpu(), dtype=float)
    expected = mission.height_errors.numpy() - comparison.common_offset
    tracks = np.array(mission.robots.tracks)
    return FleetNumbers(
        robots=mission.request.robots,
        seconds=mission.time,
        walked=float(np.hypot(*np.diff(tracks, axis=0).T).sum()),
        coverage=mission.coverage,
        rmse=_rms(comparison.error),
        rmse_off_steps=_rms(smooth),
        seams=measure_seams(smooth, comparison.saved.resolution),
        common_offset=comparison.common_offset,
        height_error_span=float(np.ptp(expected)),
        largest_offset_error=float(np.abs(found - expected).max()),
        contradictions=mission.contradictions,
        ms_per_update=_median(mission.update_ms),
        ms_per_merge=_median(mission.merge_ms),
        num_bytes=int(mission.site.num_bytes),
        wall_seconds=wall_seconds,
        offsets=[(float(a), float(b)) for a, b in zip(expected, found, strict=True)],
        history=mission.history,
    )


def _rms(error: NDArray) -> float:
    known = error[np.isfinite(error)]
    return float(np.sqrt(np.square(known).mean())) if known.size else float("nan")


def _median(times: list[float]) -> float:
    return float(np.median(times[_WARM_UP:] or times))


def measure_seams(error: NDArray, resolution: float) -> float:
    """Return the 95th percentile of how much the mean errors of neighbouring blocks differ [m].

    A robot's share of the site that lies too high or too low shows as a seam around it.

    Args:
        error: (H, W) [m], NaN where unknown and at steps.
        resolution: of a cell [m].
    """
    count = max(1, round(_BLOCK / resolution))
    H, W = (n // count for n in error.shape)
    blocks = error[: H * count, : W * count].reshape(H, count, W, count).swapaxes(1, 2).reshape(H, W, -1)
    number = np.isfinite(blocks).sum(-1)
    mean = np.where(number >= _MIN_SHARE * count**2, np.nansum(blocks, -1) / np.maximum(number, 1), np.nan)
    differences = np.abs(np.concatenate([np.diff(mean, axis=axis).ravel() for axis in (0, 1)]))
    differences = differences[np.isfinite(differences)]
    return float(np.percentile(differences, 95)) if differences.size else float("nan")
