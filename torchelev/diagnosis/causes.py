"""Rules that find mistakes in a map's inputs, worst first.

Each rule returns a sentence, or None where it finds nothing. The rules are silent where a mistake leaves no trace, as
most wrong poses do when a level lidar sees flat ground.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from torchelev.config import ElevationMapConfig
from torchelev.diagnosis.evidence import GATES, MIN_POINTS, Evidence, gather_evidence
from torchelev.diagnosis.history import MAX_ENVS, InputHistory
from torchelev.diagnosis.sensor_bias import find_alternating_corrections, find_sensor_bias
from torchelev.diagnosis.shared_range import find_points_on_path, find_shared_range
from torchelev.diagnosis.surfaces import find_cut_hillside, is_overgrown
from torchelev.state import MapState

REASONS = {
    "invalid": "are NaN or infinite, or their pose or variance is: check what makes them",
    "range": "are too near or too far: check their unit, and sensor.min_distance and sensor.max_distance",
    "body": "lie on the robot's own body: check sensor.body, T_map_base and T_base_links",
    "overhang": "lie above the exclusion ramp: check that the pose's z axis points up, that points with optical axes "
    "have a pose with such axes, and sensor.exclusion",
}


def diagnose(cfg: ElevationMapConfig, state: MapState, history: InputHistory) -> list[str]:
    """Return the findings, worst first: of each rule that in the first environment that has one."""
    evidence = [gather_evidence(cfg, state, history, env) for env in range(min(MAX_ENVS, len(state.elevation)))]
    findings = ((rule(seen) for seen in evidence if seen) for rule in _RULES)
    sentences = [next((text for text in texts if text), None) for texts in findings]
    return [text for text in sentences if text]


def _find_millimetres(seen: Evidence) -> str | None:
    """Find points in millimetres."""
    if not seen.is_in_millimetres:
        return None
    median = float(np.median(seen.distances))
    return f"points: the median distance is {median:,.0f} m, as of millimetres: check units, and multiply them by 0.001"


def _find_far_cloud(seen: Evidence) -> str | None:
    """Find points in another frame than the sensor's: near each other, and far from where the pose has the sensor."""
    cloud = seen.far_cloud
    if cloud is None:
        return None
    where = f"points: they lie {cloud.distance:,.0f} m from the sensor and within {cloud.radius:,.1f} m of each other"
    if cloud.is_at_sensor:
        return (
            f"{where}, where T_map_sensor has the sensor: they are in the map frame already, and the pose is applied "
            "twice; give sensor-frame points, inverse(T_map_sensor) times these"
        )
    return (
        f"{where}: they are in the map's frame, such as a national grid, and T_map_sensor lacks the sensor's place in "
        "it; give its pose in that frame, and sensor-frame points: subtract its position in float64"
    )


def _find_wrong_poses(seen: Evidence) -> str | None:
    """Find poses with which the ground is tilted or the scans disagree, if a common mistake explains that."""
    fit, mistakes = seen.explained
    if not mistakes:
        return None
    angle, largest = np.degrees(np.arccos(np.clip([fit.level, fit.lowest], -1, 1)))
    tilt = "" if not fit.level < 0.8 else f"the ground that the sensor sees is tilted by {angle:.0f} deg"
    apart = "" if not fit.agreement < 0.75 else f"scans agree in {100 * fit.agreement:.0f} % of the cells they share"
    numbers = " and ".join(text for text in (tilt, apart) if text)
    numbers = numbers or f"the ground that the sensor sees is tilted by up to {largest:.0f} deg"
    return f"poses: {'; or '.join(mistakes)} (as given, {numbers}; without the mistake, ground and scans fit)"


def _find_missing_pose(seen: Evidence) -> str | None:
    """Find sensor poses that were left out, as of points that are in the map frame already."""
    bases = np.array([base[:3, 3] for base in seen.bases if base is not None]).reshape(-1, 3)
    bases = bases[np.isfinite(bases).all(1)]
    moved = float(np.ptp(bases, axis=0).max()) if len(bases) else 0.0
    if moved < 0.5 or not all(np.array_equal(poses[0], np.eye(4)) for poses in seen.poses):
        return None
    return (
        f"T_map_sensor: it is the identity in all updates, while the base moves by {moved:.1f} m; give the sensor's "
        "pose, and points in its own frame: their rays start there"
    )


def _find_wrong_base(seen: Evidence) -> str | None:
    """Find a sensor that moves against the base it is mounted on; sensors that take turns return to their mounts."""
    pairs = [(base, poses[0]) for base, poses in zip(seen.bases, seen.poses, strict=True) if base is not None]
    mounts = np.array([base[:3, :3].T @ (T[:3, 3] - base[:3, 3]) for base, T in pairs]).reshape(-1, 3)
    mounts = mounts[np.isfinite(mounts).all(1)]
    if len(mounts) < 4:
        return None
    apart = np.linalg.norm(mounts[:, None] - mounts, axis=2)
    is_single = (apart < 0.1).sum(1) == 1
    if apart.max() < 0.5 or is_single.mean() < 0.5:
        return None
    return (
        f"T_map_base: the sensor moves by {apart.max():.1f} m against the base; check T_map_base and T_map_sensor: "
        "poses in the same map frame, of the same time, and not inverted"
    )


def _find_closed_gate(seen: Evidence) -> str | None:
    """Find sensor gates that reject nearly all points."""
    if seen.num_points < MIN_POINTS or seen.is_in_millimetres or seen.far_cloud:
        return None
    for name in GATES:
        tested = seen.num_points - (0 if name == "invalid" else seen.gates["invalid"])
        if tested >= MIN_POINTS and seen.gates[name] >= 0.95 * tested:
            return f"points: {seen.gates[name]:,} of {tested:,} {REASONS[name]}"
    used = sum(int(mask.sum()) for mask in seen.used)
    if used >= 0.01 * seen.num_points or seen.gates["invalid"] > 0.9 * seen.num_points:
        return None
    counts = ", ".join(f"{number:,} {name}" for name, number in seen.gates.items() if number)
    return f"points: the sensor's gates let {used:,} of {seen.num_points:,} pass ({counts}); check poses and sensor=..."


def _find_window_off_points(seen: Evidence) -> str | None:
    """Find a window that nearly all points miss, in every update."""
    half = np.array([seen.cfg.grid.length_x, seen.cfg.grid.length_y]) / 2
    fractions, away = [], 0.0
    for k, base in enumerate(seen.bases):
        points, center = seen.used_points(k)[:, :2], seen.center if base is None else base[:2, 3]
        if len(points) >= MIN_POINTS:
            fractions.append(float((np.abs(points - center) > half).any(1).mean()))
            away = float(np.linalg.norm(seen.poses[k][0][:2, 3] - center))
    if not fractions or min(fractions) < 0.95:
        return None
    hint = "give T_map_base, which the window follows" if seen.bases[-1] is None else "check T_map_base"
    hint = hint if away > half.max() else "enlarge grid.length_x and grid.length_y"
    outside = f"{100 * fractions[-1]:.0f} % of the points fall beside it"
    return f"window: {outside}, and its centre is {away:.1f} m from the sensor; {hint}"


def _find_clearing(seen: Evidence) -> str | None:
    """Find a stage that clears most of the cells it works on, in one update."""
    stages = {
        "cleared_other_floors": (4 * seen.num_near, "as other floors: check T_map_base, and overlap.height"),
        "cleared_seen_through": (seen.num_known, "as rays pass below them: check the poses' heights, and raycast"),
    }
    for name, (num_left, reason) in stages.items():
        number = seen.statistics[name]
        if number >= MIN_POINTS and num_left < number:
            return f"map: {number:,.0f} cells were cleared and {seen.num_known:,} are left, {reason}"
    return None


def _find_contradictions(seen: Evidence) -> str | None:
    """Find scans that contradict the map: the outlier gate rejects a large part of them."""
    outliers = seen.statistics["rejected_outlier"]
    total = outliers + seen.statistics["points_used"]
    if outliers < MIN_POINTS or outliers < 0.3 * total or seen.explained[1] or is_overgrown(seen):
        return None
    hint = "check that poses belong to their scans and that the map's z axis points up; see fusion.gate"
    return f"poses: {100 * outliers / total:.0f} % of the points contradict the map; {hint}"


def _find_wrong_dt(seen: Evidence) -> str | None:
    """Find a `dt` that is implausibly long for the robot's motion, or 0 in every update."""
    dt = float(np.median(seen.dt))
    if dt == 0 and seen.oldest == 0 and len(seen.positions) >= 4 and seen.travel > 0.5:
        return f"dt: 0 s in all updates, yet the robot moves {seen.travel:.1f} m; give the seconds since the last one"
    if dt < 5.0:
        return None
    moved = np.linalg.norm(np.diff(seen.positions, axis=0), axis=1) / np.maximum(np.diff(seen.numbers), 1)
    speed = float(np.median(moved)) / dt if len(moved) else 0.0
    if not (speed < 0.05 and (dt >= 10.0 or speed > 0)):
        return None
    return f"dt: {dt:g} s between updates, in which the robot moves {100 * speed:.2g} cm/s; give seconds, not ms or ns"


def _find_own_legs(seen: Evidence) -> str | None:
    """Find points above the ground that stay near the base while the robot moves."""
    if len(seen.positions) < 4 or seen.travel < 0.5 or seen.explained[1]:
        return None
    counts = [_count_beside_base(seen, k) for k in range(len(seen.numbers))]
    if np.mean(np.array(counts) >= 5) < 0.75:
        return None
    number = int(np.median(counts))
    cure = "give sensor.body=RobotBody(...) with T_base_links, or one box, BodyConfig(...), with T_map_base"
    if seen.cfg.sensor.links:
        cure = "check T_base_links: in the order of sensor.body.links, at the time of the points; or raise its padding"
    return (
        f"points: about {number} in each scan stay within 0.4 m of the robot while it moves, as of its own legs or "
        f"body; {cure}"
    )


def _count_beside_base(seen: Evidence, k: int) -> int:
    """Count used points above the ground within 0.4 m of the base or, where it is unknown, 0.35 m of the sensor."""
    points, base = seen.used_points(k), seen.bases[k]
    points = points[_height_over_ground(points, seen.positions[k]) > 0.1]
    if base is None:
        return int((np.linalg.norm(points - seen.poses[k][0][:3, 3], axis=1) < 0.35).sum())
    x, y, z = ((points - base[:3, 3]) @ base[:3, :3]).T
    return int(((np.hypot(x, y) < 0.4) & (z > -0.35) & (z < 0.1)).sum())


def _height_over_ground(points: NDArray, position: NDArray) -> NDArray:
    """Return heights (n,) [m] of points (n, 3) over the plane of the ground within 1.5 m of a position."""
    A = np.column_stack([points[:, :2] - position[:2], np.ones(len(points))])
    is_ground = np.linalg.norm(A[:, :2], axis=1) < 1.5
    height = np.zeros(len(points))
    for _ in range(4):  # each fit leaves out points more than 5 cm above the previous one
        if is_ground.sum() >= 3:
            height = points[:, 2] - A @ np.linalg.lstsq(A[is_ground], points[is_ground, 2], rcond=None)[0]
            is_ground &= height < 0.05
    return height


_RULES = (
    _find_millimetres,
    _find_far_cloud,
    find_shared_range,
    find_points_on_path,
    _find_missing_pose,
    _find_wrong_poses,
    _find_wrong_base,
    find_sensor_bias,
    find_alternating_corrections,
    find_cut_hillside,
    _find_closed_gate,
    _find_window_off_points,
    _find_clearing,
    _find_contradictions,
    _find_wrong_dt,
    _find_own_legs,
)
