"""What looks wrong with what a map was given: one rule per mistake, each a sentence or None, worst first.

The rules look at a few recent inputs (`Recent`), at the last update's statistics and at the map. They are silent where
a mistake leaves no trace, as most wrong poses do of flat ground seen by a level lidar.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
import torch
from numpy.typing import NDArray

from torchelev.config import ElevationMapConfig
from torchelev.diagnosis.pose_hypotheses import Fit, Scan, explain
from torchelev.diagnosis.recent import ENVS, Look, Recent
from torchelev.grid import cell_centers
from torchelev.stages.measure import measure
from torchelev.state import MapState

FEW = 20  # points from which on a share of them means something
GATES = {
    "invalid": "are NaN or infinite, or their pose or variance is: check what makes them",
    "range": "are too near or too far: check their unit, and sensor.min_distance and sensor.max_distance",
    "body": "lie in the robot's body box: check sensor.body and T_map_base",
    "overhang": "lie above the exclusion ramp: check that the pose's z axis points up, and sensor.exclusion",
}


@dataclass(frozen=True)
class Evidence:
    """What is known of one environment, on the host."""

    cfg: ElevationMapConfig  #: of the map
    numbers: list[int]  #: of the updates, one per look
    points: list[list[NDArray]]  #: [m] sensor frame, per look and sensor, (n, 3); not all are finite
    poses: list[list[NDArray]]  #: T_map_sensor, per look and sensor
    bases: list[NDArray | None]  #: T_map_base of each update, None where none was given
    dt: NDArray  #: [s]
    gates: dict[str, int]  #: points of all looks by the gate that rejected them
    used: list[NDArray]  #: which points of a look passed the sensor's gates
    statistics: dict[str, float]  #: of the last update
    num_known: int  #: cells
    num_near: int  #: known cells where overlap clearance works
    oldest: float  #: [s] since the known cell that waits longest was hit
    center: NDArray  #: (2,) [m] of the window

    @cached_property
    def num_points(self) -> int:
        """How many points there were."""
        return sum(len(cloud) for clouds in self.points for cloud in clouds)

    def in_map(self, k: int) -> NDArray:
        """Return the points (n, 3) [m] of look k that passed the sensor's gates, in the map frame."""
        clouds = [cloud @ T[:3, :3].T + T[:3, 3] for cloud, T in zip(self.points[k], self.poses[k], strict=True)]
        return np.concatenate(clouds)[self.used[k]]

    @cached_property
    def scans(self) -> list[Scan]:
        """The finite points with their poses."""
        looks = enumerate(zip(self.points, self.poses, strict=True))
        pairs = [(k, cloud, T) for k, look in looks for cloud, T in zip(*look, strict=True)]
        finite = [(k, cloud[np.isfinite(cloud).all(1)], T) for k, cloud, T in pairs if np.isfinite(T).all()]
        return [Scan(cloud, T, k) for k, cloud, T in finite if len(cloud)]

    @cached_property
    def explained(self) -> tuple[Fit, list[str]]:
        """Whether the poses fit, and the mistakes that would explain why not."""
        return explain(self.scans) if self.scans and not millimetres(self) else (Fit(np.nan, np.nan, np.nan), [])

    @cached_property
    def distances(self) -> NDArray:
        """[m] of the finite points from their sensors."""
        return np.concatenate([np.linalg.norm(scan.points, axis=1) for scan in self.scans] or [np.zeros(0)])

    @cached_property
    def places(self) -> NDArray:
        """(L, 3) [m] where the base, or else the first sensor, was at each look."""
        poses = [sensors[0] if base is None else base for sensors, base in zip(self.poses, self.bases, strict=True)]
        return np.array([T[:3, 3] for T in poses])

    @cached_property
    def travel(self) -> float:
        """[m] along the axis of the map along which the robot moved most."""
        return float(np.ptp(self.places, axis=0).max())


def diagnose(cfg: ElevationMapConfig, state: MapState, recent: Recent) -> list[str]:
    """Return what looks wrong, worst first, each once."""
    looks = [(env, recent.looks_at(env)) for env in range(min(ENVS, len(state.elevation)))]
    everything = [evidence(cfg, state, seen, env) for env, seen in looks if seen]
    found = ((rule(seen) for seen in everything) for rule in RULES)
    sentences = [next((text for text in texts if text), None) for texts in found]
    return [text for text in sentences if text]


def evidence(cfg: ElevationMapConfig, state: MapState, looks: Sequence[Look], env: int) -> Evidence:
    """Read one environment's share back."""
    gates, used = dict.fromkeys(GATES, 0), []
    for look in looks:
        base = None if look.T_map_base is None else look.T_map_base[env, None]
        variance = None if look.variance is None else look.variance[env, None]
        m = measure(
            look.points[env, None],
            look.T_map_sensor[env, None],
            base,
            look.dt[env, None],
            variance,
            cfg.grid,
            cfg.sensor,
            torch.float32,
        )
        gates = {name: number + int(getattr(m, f"rejected_{name}")) for name, number in gates.items()}
        used.append(m.used[0].cpu().numpy())
    grid = cfg.grid
    corner = state.corner[env].double().cpu().numpy() * grid.resolution
    return Evidence(
        cfg=cfg,
        numbers=[look.number for look in looks],
        points=[list(look.points[env].double().cpu().numpy()) for look in looks],
        poses=[list(look.T_map_sensor[env].double().cpu().numpy()) for look in looks],
        bases=[None if look.T_map_base is None else look.T_map_base[env].double().cpu().numpy() for look in looks],
        dt=np.array([float(look.dt[env]) for look in looks]),
        gates=gates,
        used=used,
        statistics={name: float(value[env]) for name, value in state.statistics._asdict().items()},
        num_known=int(state.validity[env].sum()),
        oldest=float(torch.where(state.validity[env], state.time[env], 0.0).max()),
        num_near=_known_near(cfg, state, looks[-1], env),
        center=corner + [grid.length_x / 2, grid.length_y / 2],
    )


def _known_near(cfg: ElevationMapConfig, state: MapState, look: Look, env: int) -> int:
    if look.T_map_base is None or cfg.overlap is None:
        return 0
    away = cell_centers(state.corner[env, None], cfg.grid)[0] - look.T_map_base[env, :2, 3]
    return int((state.validity[env] & (away.norm(dim=-1) <= cfg.overlap.radius)).sum())


def millimetres(seen: Evidence) -> str | None:
    """Points hundreds of times as far away as sensors see."""
    if len(seen.distances) < FEW or seen.gates["range"] < 0.5 * len(seen.distances):
        return None
    median = float(np.median(seen.distances))
    if median < max(250.0, 2 * seen.cfg.sensor.max_distance):
        return None
    return f"points: the median distance is {median:,.0f} m, as of millimetres: check units, and multiply them by 0.001"


def wrong_poses(seen: Evidence) -> str | None:
    """Poses under which the ground is not level, or the scans do not agree, and a usual mistake that explains it."""
    fit, mistakes = seen.explained
    if not mistakes:
        return None
    tilt = "" if not fit.level < 0.8 else f"the ground that the sensor sees is tilted by {_degrees(fit.level):.0f} deg"
    apart = "" if not fit.agreement < 0.75 else f"scans agree in {100 * fit.agreement:.0f} % of the cells they share"
    numbers = " and ".join(text for text in (tilt, apart) if text)
    return f"poses: {'; or '.join(mistakes)} (as given, {numbers}; without the mistake, ground and scans fit)"


def wrong_base(seen: Evidence) -> str | None:
    """The sensor moves against the base on which it is mounted. Sensors that take turns come back to their mounts."""
    pairs = [(base, look[0]) for base, look in zip(seen.bases, seen.poses, strict=True) if base is not None]
    mounts = np.array([base[:3, :3].T @ (T[:3, 3] - base[:3, 3]) for base, T in pairs]).reshape(-1, 3)
    mounts = mounts[np.isfinite(mounts).all(1)]
    if len(mounts) < 4:
        return None
    apart = np.linalg.norm(mounts[:, None] - mounts, axis=2)
    alone = (apart < 0.1).sum(1) == 1
    if apart.max() < 0.5 or alone.mean() < 0.5:
        return None
    return (
        f"T_map_base: the sensor moves by {apart.max():.1f} m against the base; check T_map_base and T_map_sensor: "
        "poses in the same map frame, of the same time, and not inverted"
    )


def _degrees(cosine: float) -> float:
    return float(np.degrees(np.arccos(np.clip(cosine, -1, 1))))


def rejected(seen: Evidence) -> str | None:
    """One gate of the sensor rejects nearly everything."""
    if seen.num_points < FEW or millimetres(seen):
        return None
    for name, reason in GATES.items():
        left = seen.num_points - (0 if name == "invalid" else seen.gates["invalid"])
        if left >= FEW and seen.gates[name] >= 0.95 * left:
            return f"points: {seen.gates[name]:,} of {left:,} {reason}"
    used = sum(int(mask.sum()) for mask in seen.used)
    if used >= 0.01 * seen.num_points or seen.gates["invalid"] > 0.9 * seen.num_points:
        return None
    shares = ", ".join(f"{number:,} {name}" for name, number in seen.gates.items() if number)
    return f"points: the sensor's gates let {used:,} of {seen.num_points:,} pass ({shares}); check poses and sensor=..."


def out_of_reach(seen: Evidence) -> str | None:
    """The window lies where no points fall, in any look."""
    half = np.array([seen.cfg.grid.length_x, seen.cfg.grid.length_y]) / 2
    shares, away = [], 0.0
    for k, base in enumerate(seen.bases):
        points, center = seen.in_map(k)[:, :2], seen.center if base is None else base[:2, 3]
        if len(points) >= FEW:
            shares.append(float((np.abs(points - center) > half).any(1).mean()))
            away = float(np.linalg.norm(seen.poses[k][0][:2, 3] - center))
    if not shares or min(shares) < 0.95:
        return None
    hint = "give T_map_base, which the window follows" if seen.bases[-1] is None else "check T_map_base"
    hint = hint if away > half.max() else "enlarge grid.length_x and grid.length_y"
    share = f"{100 * shares[-1]:.0f} % of the points fall beside it"
    return f"window: {share}, and its centre is {away:.1f} m from the sensor; {hint}"


def contradicted(seen: Evidence) -> str | None:
    """The outlier gate rejects a large share: scans do not agree with each other."""
    outliers = seen.statistics["rejected_outlier"]
    total = outliers + seen.statistics["points_used"]
    if outliers < FEW or outliers < 0.3 * total or seen.explained[1]:
        return None
    hint = "check that poses belong to their scans and that the map's z axis points up; see fusion.gate"
    return f"poses: {100 * outliers / total:.0f} % of the points contradict the map; {hint}"


def cleared(seen: Evidence) -> str | None:
    """One stage clears most of what it works on, in an update that takes points in."""
    stages = {
        "cleared_other_floors": (4 * seen.num_near, "as other floors: check T_map_base, and overlap.height"),
        "cleared_seen_through": (seen.num_known, "as rays pass below them: check the poses' heights, and raycast"),
    }
    for name, (left, reason) in stages.items():
        number = seen.statistics[name]
        if number >= FEW and left < number:
            return f"map: {number:,.0f} cells were cleared and {seen.num_known:,} are left, {reason}"
    return None


def wrong_times(seen: Evidence) -> str | None:
    """Times so long that the robot hardly moves, or stands for ages between two scans, or no time at all."""
    dt = float(np.median(seen.dt))
    if dt == 0 and seen.oldest == 0 and len(seen.places) >= 4 and seen.travel > 0.5:
        return f"dt: 0 s in all updates, yet the robot moves {seen.travel:.1f} m; give the seconds since the last one"
    if dt < 5.0:
        return None
    moved = np.linalg.norm(np.diff(seen.places, axis=0), axis=1) / np.maximum(np.diff(seen.numbers), 1)
    speed = float(np.median(moved)) / dt if len(moved) else 0.0
    if not (speed < 0.05 and (dt >= 10.0 or speed > 0)):
        return None
    return f"dt: {dt:g} s between updates, in which the robot moves {100 * speed:.2g} cm/s; give seconds, not ms or ns"


def own_legs(seen: Evidence) -> str | None:
    """Points that move with the robot, where nothing else can be: within its own body's reach, above the ground."""
    if len(seen.places) < 4 or seen.travel < 0.5 or seen.explained[1]:
        return None
    counts = [_beside_base(seen, k) for k in range(len(seen.numbers))]
    if np.mean(np.array(counts) >= 5) < 0.75:
        return None
    number = int(np.median(counts))
    return (
        f"points: about {number} in each scan stay within 0.4 m of the robot while it moves, as of its own legs or "
        "body; give sensor.body=BodyConfig(...) and T_map_base, or a larger sensor.min_distance"
    )


def _beside_base(seen: Evidence, k: int) -> int:
    """Count points used that stand above the ground within 0.4 m of the base; without one, 0.35 m of the sensor."""
    points, base = seen.in_map(k), seen.bases[k]
    points = points[_above_ground(points, seen.places[k]) > 0.1]
    if base is None:
        return int((np.linalg.norm(points - seen.poses[k][0][:3, 3], axis=1) < 0.35).sum())
    x, y, z = ((points - base[:3, 3]) @ base[:3, :3]).T
    return int(((np.hypot(x, y) < 0.4) & (z > -0.35) & (z < 0.1)).sum())


def _above_ground(points: NDArray, place: NDArray) -> NDArray:
    """Return how far points (n, 3) lie above the plane of the ground within 1.5 m of a place (n,) [m]."""
    A = np.column_stack([points[:, :2] - place[:2], np.ones(len(points))])
    ground = np.linalg.norm(A[:, :2], axis=1) < 1.5
    above = np.zeros(len(points))
    for _ in range(4):  # what stands on the ground is left out, the more the better the plane fits
        if ground.sum() >= 3:
            above = points[:, 2] - A @ np.linalg.lstsq(A[ground], points[ground, 2], rcond=None)[0]
            ground &= above < 0.05
    return above


RULES = (millimetres, wrong_poses, wrong_base, rejected, out_of_reach, cleared, contradicted, wrong_times, own_legs)
