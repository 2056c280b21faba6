"""The evidence for a diagnosis: recent inputs, statistics and state of one environment, on the host."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray

from torchelev.config import ElevationMapConfig
from torchelev.diagnosis.history import InputHistory, PastUpdate
from torchelev.diagnosis.pose_hypotheses import explain
from torchelev.diagnosis.scan_fit import Fit, Scan
from torchelev.grid import cell_centers
from torchelev.inputs.update_inputs import Inputs
from torchelev.stages.measure.stage import measure
from torchelev.state import MapState, Measurement

MIN_POINTS = 20  # points that a fraction or a median must rest on
FAR = 250.0  # [m] farther than sensors of robots measure
GATES = ("invalid", "range", "body", "overhang")  # of the sensor, in their order


class FarCloud(NamedTuple):
    """A cloud whose points are near each other and far from the sensor."""

    distance: float  #: [m] of its middle from the sensor
    radius: float  #: [m] median distance of its points from the middle
    is_at_sensor: bool  #: read in the map frame, it lies at the sensor's pose


@dataclass(frozen=True)
class Evidence:
    """The evidence of one environment. Lists have one entry per update."""

    cfg: ElevationMapConfig  #: configuration of the map
    numbers: list[int]  #: numbers of the updates
    points: list[list[NDArray]]  #: (n, 3) [m] sensor frame, per sensor; not all are finite
    poses: list[list[NDArray]]  #: T_map_sensor, per sensor
    bases: list[NDArray | None]  #: T_map_base; None where none was given
    dt: NDArray  #: [s]
    gates: dict[str, int]  #: points of all updates, by the gate that rejected them
    used: list[NDArray]  #: mask of the points that passed the sensor's gates
    overhang: list[NDArray]  #: mask of the points that only the exclusion ramp rejected
    epsilon: float  #: relative spacing of numbers in the dtype of the points
    statistics: dict[str, float]  #: of the last update
    corrections: list[float]  #: [m] of the height drift, of updates in a row
    num_known: int  #: known cells
    num_near: int  #: known cells within the radius of overlap clearance
    oldest: float  #: [s] since the last hit of the known cell that waits longest
    center: NDArray  #: (2,) [m] centre of the window

    @cached_property
    def num_points(self) -> int:
        """Total number of points of all updates."""
        return sum(len(cloud) for clouds in self.points for cloud in clouds)

    @cached_property
    def scans(self) -> list[Scan]:
        """Each sensor's finite points, with its pose and that of the base."""
        updates = zip(self.points, self.poses, self.bases, strict=True)
        given = [(cloud, T, base) for clouds, Ts, base in updates for cloud, T in zip(clouds, Ts, strict=True)]
        finite = [(cloud[np.isfinite(cloud).all(1)], T, base) for cloud, T, base in given if np.isfinite(T).all()]
        return [Scan(*scan) for scan in finite if len(scan[0])]

    @cached_property
    def distances(self) -> NDArray:
        """[m] of the finite points from their sensors."""
        return np.concatenate([np.linalg.norm(scan.points, axis=1) for scan in self.scans] or [np.zeros(0)])

    @cached_property
    def is_beyond_range(self) -> bool:
        """Whether most points are rejected for their distance."""
        return len(self.distances) >= MIN_POINTS and self.gates["range"] >= 0.5 * len(self.distances)

    @cached_property
    def far_cloud(self) -> FarCloud | None:
        """The cloud, if its points are near each other and far from the sensor: they are in another frame."""
        if not self.is_beyond_range:
            return None
        scan = self.scans[-1]
        middle = np.median(scan.points, axis=0)
        distance = float(np.linalg.norm(middle))
        radius = float(np.median(np.linalg.norm(scan.points - middle, axis=1)))

        def is_at(T: NDArray | None) -> bool:
            return T is not None and bool(np.linalg.norm(middle - T[:3, 3]) < 0.2 * distance)

        is_near = radius < min(0.2 * distance, self.cfg.sensor.max_distance)  # in metres; millimetres spread farther
        is_elsewhere = is_at(scan.T) or is_at(scan.base) or distance >= FAR
        return FarCloud(distance, radius, is_at(scan.T)) if is_near and is_elsewhere else None

    @cached_property
    def is_in_millimetres(self) -> bool:
        """Whether the points lie hundreds of times as far away as sensors measure, and as far from each other."""
        if not self.is_beyond_range or self.far_cloud is not None:
            return False
        return float(np.median(self.distances)) >= max(FAR, 2 * self.cfg.sensor.max_distance)

    @cached_property
    def explained(self) -> tuple[Fit, list[str]]:
        """The fit of poses and points, and the mistakes that would explain a bad one."""
        is_comparable = self.scans and not (self.is_in_millimetres or self.far_cloud)
        return explain(self.scans) if is_comparable else (Fit(np.nan, np.nan, np.nan, np.nan), [])

    @cached_property
    def positions(self) -> NDArray:
        """(n, 3) [m] of the base, or of the first sensor where the base is unknown, per update."""
        poses = [sensors[0] if base is None else base for sensors, base in zip(self.poses, self.bases, strict=True)]
        return np.array([T[:3, 3] for T in poses])

    @cached_property
    def travel(self) -> float:
        """[m] that the robot moved along the map's axis along which it moved most."""
        return float(np.ptp(self.positions, axis=0).max())

    def used_points(self, k: int) -> NDArray:
        """Return the points (n, 3) [m] of update k that passed the sensor's gates, map frame."""
        sensors = np.split(self.used[k], len(self.points[k]))
        given = zip(self.points[k], self.poses[k], sensors, strict=True)
        return np.concatenate([cloud[mask] @ T[:3, :3].T + T[:3, 3] for cloud, T, mask in given])


def gather_evidence(cfg: ElevationMapConfig, state: MapState, history: InputHistory, env: int) -> Evidence | None:
    """Copy the evidence of one environment to the host; None if it has had no update."""
    updates = history.updates_of(env)
    if not updates:
        return None
    inputs = [update.inputs for update in updates]
    measured = [_measure_again(cfg, update, env) for update in updates]
    known, corner = state.validity[env], state.corner[env].double().cpu().numpy()
    return Evidence(
        cfg=cfg,
        numbers=[update.number for update in updates],
        points=[list(given.points[env].double().cpu().numpy()) for given in inputs],
        poses=[list(given.T_map_sensor[env].double().cpu().numpy()) for given in inputs],
        bases=[None if given.T_map_base is None else given.T_map_base[env].double().cpu().numpy() for given in inputs],
        dt=np.array([float(given.dt[env]) for given in inputs]),
        gates={name: sum(int(getattr(m, f"rejected_{name}")) for m in measured) for name in GATES},
        used=[m.used[0].cpu().numpy() for m in measured],
        overhang=[(m.casts & ~m.used)[0].cpu().numpy() for m in measured],
        epsilon=torch.finfo(inputs[0].points.dtype).eps,
        statistics={name: float(value[env]) for name, value in state.statistics._asdict().items()},
        corrections=[*history.corrections_of(env), float(state.statistics.drift_correction[env])],
        num_known=int(known.sum()),
        num_near=_count_near(cfg, state, updates[-1], env),
        oldest=float(torch.where(known, state.time[env], 0.0).max()),
        center=corner * cfg.grid.resolution + [cfg.grid.length_x / 2, cfg.grid.length_y / 2],
    )


def _measure_again(cfg: ElevationMapConfig, update: PastUpdate, env: int) -> Measurement:
    """Return one environment's measurement of an update's thinned points."""
    of_env: Any = (None if value is None else value[env, None] for value in update.inputs)
    return measure(*Inputs(*of_env), cfg.grid, cfg.sensor, torch.float32)


def _count_near(cfg: ElevationMapConfig, state: MapState, update: PastUpdate, env: int) -> int:
    """Count the known cells in reach of overlap clearance."""
    T_map_base = update.inputs.T_map_base
    if T_map_base is None or cfg.overlap is None:
        return 0
    away = cell_centers(state.corner[env, None], cfg.grid)[0] - T_map_base[env, :2, 3]
    return int((state.validity[env] & (away.norm(dim=-1) <= cfg.overlap.radius)).sum())
