"""The stages as slow NumPy loops over points and cells, written from the paper's equations.

Nothing here comes from torchelev: plain numbers, lists, dicts and float64 arrays of one environment. A map is a dict of
(H, W) arrays; `corner` holds the cell numbers of cell [0, 0] on the map frame's lattice. Points are absolute.
"""

import math

import numpy as np

# Where cells are ------------------------------------------------------------------------------------------------------


def cell_of(x, y, corner, resolution, shape):
    """The cell (i, j) that holds a map-frame position, or None outside the window."""
    i = math.floor(x / resolution) - corner[0]
    j = math.floor(y / resolution) - corner[1]
    return (i, j) if 0 <= i < shape[0] and 0 <= j < shape[1] else None


def center_of(i, j, corner, resolution):
    """The centre of a cell [m]."""
    return (corner[0] + i + 0.5) * resolution, (corner[1] + j + 0.5) * resolution


def window_corner(x, y, resolution, shape):
    """The corner of the window whose centre is nearest to a position, whole cells only."""
    return tuple(math.floor(p / resolution - n / 2 + 0.5) for p, n in zip((x, y), shape, strict=True))


def recenter(layer, old_corner, new_corner, blank):
    """A layer after the window has moved: what was there stays on its place in the world, the rest is blank."""
    moved = np.full_like(layer, blank)
    H, W = layer.shape
    for i in range(H):
        for j in range(W):
            old_i, old_j = i + new_corner[0] - old_corner[0], j + new_corner[1] - old_corner[1]
            if 0 <= old_i < H and 0 <= old_j < W:
                moved[i, j] = layer[old_i, old_j]
    return moved


# From points to a measurement -----------------------------------------------------------------------------------------


def above_ramp(dx, dy, dz, slope, distance, offset, height):
    """The exclusion area: z - z_s > min(max(r - b, 0) * tan(theta_a) + c, d)."""
    r = math.hypot(dx, dy)
    return dz > min(max(r - distance, 0.0) * slope + offset, height)


def inside_box(point, T_map_base, lower, upper):
    """Whether a map-frame point lies in a box of the base frame."""
    in_base = np.linalg.inv(T_map_base) @ np.append(point, 1.0)
    return all(lower[k] <= in_base[k] <= upper[k] for k in range(3))


def rotation_of(quat_wxyz):
    """The matrix that turns v to v + 2 w (q x v) + 2 q x (q x v), column by column."""
    w, q = quat_wxyz[0], np.array(quat_wxyz[1:])
    return np.column_stack([v + 2 * w * np.cross(q, v) + 2 * np.cross(q, np.cross(q, v)) for v in np.eye(3)])


def outside_capsule(p, start, end, radius):
    """How far outside a capsule a point lies, both in the link's frame; negative inside."""
    start, axis = np.array(start), np.array(end) - np.array(start)
    v = min(max(np.dot(p - start, axis) / np.dot(axis, axis), 0.0), 1.0) if axis.any() else 0.0
    return np.linalg.norm(p - start - v * axis) - radius


def outside_box(p, center, half_lengths, rotation):
    """How far a point lies outside the faces of a box, both in the link's frame; negative inside."""
    in_box = (p - np.array(center)) @ rotation
    return max(abs(in_box[k]) - half_lengths[k] for k in range(3))


def least(f, low, high):
    """The least value of a convex function between two numbers, by thirds."""
    for _ in range(40):
        a, b = low + (high - low) / 3, high - (high - low) / 3
        low, high = (low, b) if f(a) <= f(b) else (a, high)
    return f((low + high) / 2)


def shapes_of(robot, T_map_links):
    """A function of a map-frame point for each shape: how far it lies outside, negative inside.

    `robot` holds lists of dicts, `T_map_links` the poses by the link's name.
    """
    shapes = []
    for kind, outside in (("capsules", outside_capsule), ("boxes", outside_box)):
        for shape in robot[kind]:
            to_link = np.linalg.inv(T_map_links[shape["link"]])
            sizes = {key: value for key, value in shape.items() if key not in ("link", "quat_wxyz")}
            if kind == "boxes":
                sizes["rotation"] = rotation_of(shape["quat_wxyz"])
            shapes.append(lambda p, f=outside, T=to_link, s=sizes: f(T[:3, :3] @ p + T[:3, 3], **s))
    return shapes


def outside_robot(p, origin, robot, T_map_links):
    """How far a point and what is up to `depth_tolerance` behind it lie outside the padded robot; on it if <= 0."""
    ray = (p - origin) / np.linalg.norm(p - origin)
    nearest = [
        least(lambda t, f=outside: f(p + t * ray), 0.0, robot["depth_tolerance"])
        for outside in shapes_of(robot, T_map_links)
    ]
    return min(nearest) - robot["padding"]


def first_hit(origin, ray, robot, T_map_links, reach):
    """The distance at which a ray enters its first shape from outside, inf for none.

    No shape is nearer than it is far outside, so that steps of that length enter none.
    """
    hits = [math.inf]
    for outside in shapes_of(robot, T_map_links):
        t, inside = 0.0, outside(origin) <= 0
        while not inside and t < reach:
            step = outside(origin + t * ray)
            if step < 1e-6:
                hits.append(t)
                break
            t += step
    return min(hits)


def measure(points, T_map_sensor, T_map_base, *, noise, limits, exclusion=None, body=None):
    """Transform and gate the points (S, N, 3) of sensors with poses (S, 4, 4): a list of dicts, sensor after sensor.

    Each has `gate`: "used", or the first gate that rejected it. sigma_p^2 = alpha_d * d^2 + floor, `noise` = (alpha_d,
    floor). `limits` = (minimum, maximum distance); `exclusion` and `body` are dicts of their parameters.
    """
    measured = []
    for s, cloud in enumerate(points):
        for p in cloud:
            out = {"sensor": s, "origin": T_map_sensor[s][:3, 3], "gate": "used"}
            measured.append(out)
            if not all(math.isfinite(c) for c in p):
                out["gate"] = "invalid"
                continue
            d = math.sqrt(sum(c * c for c in p)) if max(abs(c) for c in p) < 1e100 else math.inf
            if not limits[0] <= d <= limits[1]:
                out["gate"] = "range"
                continue
            turned = T_map_sensor[s][:3, :3] @ p
            out["point"] = turned + T_map_sensor[s][:3, 3]
            out["variance"] = noise[0] * d * d + noise[1]
            if body is not None and T_map_base is not None and inside_box(out["point"], T_map_base, **body):
                out["gate"] = "body"
            elif exclusion is not None and above_ramp(*turned, **exclusion):
                out["gate"] = "overhang"
    return measured


def pose_variance(relative, covariance):
    """J Sigma J^T of a point's height, J = (0, 0, 1, r_y, -r_x, 0); `relative` is the point less the sensor."""
    J = [0.0, 0.0, 1.0, relative[1], -relative[0], 0.0]
    return sum(J[i] * covariance[i][j] * J[j] for i in range(6) for j in range(6))


def absolute_variance(variance, gradient, covariance):
    """The elevation's own variance and n^T Sigma n of the position that it counts from, n = (-g_x, -g_y, 1)."""
    n = [-gradient[0], -gradient[1], 1.0]
    return variance + sum(n[i] * covariance[i][j] * n[j] for i in range(3) for j in range(3))


def quaternion_of(R):
    """The unit quaternion (w, x, y, z) of a rotation matrix, by its largest component."""
    t = [R[0][0] + R[1][1] + R[2][2], R[0][0], R[1][1], R[2][2]]
    k = t.index(max(t))
    if k == 0:
        q = [1 + t[0], R[2][1] - R[1][2], R[0][2] - R[2][0], R[1][0] - R[0][1]]
    else:
        i, j, m = k - 1, k % 3, (k + 1) % 3
        q = [R[m][j] - R[j][m], 0.0, 0.0, 0.0]
        q[1 + i] = 1 + R[i][i] - R[j][j] - R[m][m]
        q[1 + j], q[1 + m] = R[j][i] + R[i][j], R[m][i] + R[i][m]
    length = math.sqrt(sum(c * c for c in q))
    return [c / length for c in q]


def pose_at(time, stamps, poses):
    """The pose at a time: positions linear, rotations by slerp; before the first and after the last as near them."""
    k = max([i for i in range(len(stamps) - 1) if stamps[i] <= time], default=0)
    u = (time - stamps[k]) / (stamps[k + 1] - stamps[k])
    a, b = quaternion_of(poses[k][:3, :3]), quaternion_of(poses[k + 1][:3, :3])
    dot = sum(x * y for x, y in zip(a, b, strict=True))
    if dot < 0:
        b, dot = [-c for c in b], -dot
    angle = math.acos(min(dot, 1.0))
    if angle > 1e-9:
        weights = math.sin((1 - u) * angle) / math.sin(angle), math.sin(u * angle) / math.sin(angle)
    else:
        weights = 1 - u, u
    T = np.eye(4)
    T[:3, :3] = rotation_of([weights[0] * x + weights[1] * y for x, y in zip(a, b, strict=True)])
    T[:3, 3] = (1 - u) * poses[k][:3, 3] + u * poses[k + 1][:3, 3]
    return T


def deskew(points, times, poses, stamps, at):
    """Each point (N, 3) at its own time, as the sensor would have seen it at one instant."""
    T_at = np.linalg.inv(pose_at(at, stamps, poses))
    seen = []
    for point, time in zip(points, times, strict=True):
        in_map = pose_at(time, stamps, poses) @ np.array([*point, 1.0])
        seen.append((T_at @ in_map)[:3])
    return np.array(seen)


def depth_to_points(depth, fx, fy, cx, cy, along):
    """The points of a depth image (h, w), optical frame, row after row; NaN where there is no depth."""
    points = []
    for v in range(depth.shape[0]):
        for u in range(depth.shape[1]):
            ray = np.array([(u - cx) / fx, (v - cy) / fy, 1.0])
            if along == "ray":
                ray = ray / np.linalg.norm(ray)
            d = depth[v, u]
            points.append(ray * d if math.isfinite(d) and d > 0 else np.full(3, math.nan))
    return np.array(points)


def voxel_means(points, size):
    """The mean of the points of each voxel, by voxel."""
    voxels = {}
    for p in points:
        if np.isfinite(p).all():
            voxels.setdefault(tuple(math.floor(c / size) for c in p), []).append(p)
    return {key: np.mean(group, axis=0) for key, group in voxels.items()}


# The height update --------------------------------------------------------------------------------------------------


def kalman(h, variance, points):
    """The paper's equations (1) and (2), point (p_z, sigma_p^2) after point."""
    for z, point_variance in points:
        h = (point_variance * h + variance * z) / (variance + point_variance)
        variance = variance * point_variance / (variance + point_variance)
    return h, variance


def passed_center(x, y, origin, corner, resolution, shape):
    """Whether a point's ray passed over its cell's middle: the point lies within 45 degrees of straight behind it."""
    cx, cy = center_of(*cell_of(x, y, corner, resolution, shape), corner, resolution)
    dx, dy, rx, ry = x - cx, y - cy, x - origin[0], y - origin[1]
    return dx * rx + dy * ry > abs(dx * ry - dy * rx)


def agrees(p, height, variance, relief, gate):
    """|z - h| <= gate * sqrt(sigma_h^2 + sigma_p^2 + relief^2)."""
    return abs(p["z"] - height) <= gate * math.sqrt(variance + p["variance"] + relief**2)


def weighted_mean(points, value=lambda p: p["z"], weight=lambda p: 1.0):
    """The mean over points of weight 1 / sigma_p^2, times `weight`."""
    weights = [weight(p) / p["variance"] for p in points]
    return sum(w * value(p) for w, p in zip(weights, points, strict=True)) / sum(weights)


def consensus(points, relief, rounds=2):
    """A robust mean: weights 1 / (1 + r^2 / sigma^2)^2 of the residuals r, from the mean on."""
    height = weighted_mean(points)
    for _ in range(rounds):
        height = weighted_mean(
            points,
            weight=lambda p, h=height: (1 + (p["z"] - h) ** 2 / (p["variance"] + relief**2)) ** -2,
        )
    return height


def extreme(points, side, edges, relief, rounds):
    """The top (+1) or bottom (-1) of the points: the mean of those beyond the mean, repeated while enough are there."""
    level = weighted_mean(points)
    for _ in range(rounds):
        noises = [math.sqrt(p["variance"] + relief**2) for p in points]
        beyond = [p for p, n in zip(points, noises, strict=True) if side * (p["z"] - level) >= -edges["margin"] * n]
        further = weighted_mean(beyond)
        if sum(side * (p["z"] - further) >= -n for p, n in zip(points, noises, strict=True)) < edges["min_extreme"]:
            break
        level = further
    return level


def side_of_step(points, edges, relief, shown):
    """+1 and the top's height, or -1 and the ground's, of a cell that holds a step.

    The ground wins where rays passed the centre and hit low, if a neighbouring cell shows the top: by the mean height
    of its points, of which `shown[0]` is the highest, or behind it by its height in the map, `shown[1]` by (i, j).
    """
    mean, top = weighted_mean(points), extreme(points, 1, edges, relief, edges["refinements"])
    low = [p for p in points if p["z"] < mean]
    passed = sum(p["beyond"] for p in low) > edges["min_passed"] * len(low)
    rx, ry = (sum(p["ray"][axis] for p in points) for axis in (0, 1))
    angles = {(i, j): math.degrees(math.atan2(i * ry - j * rx, i * rx + j * ry)) for i, j in shown[1]}
    behind = [height for place, height in shown[1].items() if abs(angles[place]) < 50]
    if passed and (shown[0] >= (mean + top) / 2 or max(behind, default=-math.inf) >= top - relief):
        return -1, extreme(points, -1, edges, relief, rounds=2)
    return 1, top


def scan_height(cell, points, relief, shown, *, gate, max_gate_std, edges):
    """What a scan says of a cell: its height, the points kept, how many were ignored, and how many speak for the cell.

    Points on the face of a wall speak for its top; whoever sees less of a face has nothing against a settled top.
    """
    gate_variance = min(cell["variance"], max_gate_std**2)
    near = [cell["known"] and agrees(p, cell["elevation"], gate_variance, relief, gate) for p in points]
    if 2 * sum(near) >= len(points):
        guess = cell["elevation"]
    else:
        guess, gate_variance = consensus(points, relief), 0.0
    side = margin = 0
    if edges is not None:
        margin = edges["margin"]
        far = sum(not agrees(p, guess, gate_variance, relief, gate) for p in points)
        if len(points) >= edges["min_points"] and far >= edges["min_share"] * len(points):
            side, guess = side_of_step(points, edges, relief, shown)
    wrong = [side * (p["z"] - guess) < -margin * math.sqrt(p["variance"] + relief**2) for p in points]
    kept = [p for p, w in zip(points, wrong, strict=True) if not w and agrees(p, guess, gate_variance, relief, gate)]
    height = weighted_mean(kept) if kept else guess
    for_cell = sum(n and not w for n, w in zip(near, wrong, strict=True))
    if side > 0 and height < cell["elevation"] and cell["support"] >= edges["min_settled"]:
        for_cell = len(kept) + sum(wrong)
    above = cell["known"] and 2 * sum(near) < len(points) and guess > cell["elevation"]
    return height, kept, sum(wrong), for_cell, guess if above else None


def challenge(cell, number, guess, sigma2, gate, challengers, min_above, max_above_per_scan):
    """The challenger and its support after a scan of so many points around `guess`, None if not above the elevation.

    Four `challengers` or more in the 3 x 3 window, at whatever heights, are one obstacle's.
    """
    challenger, support, votes = cell["challenger"], cell["challenger_support"], min(number, max_above_per_scan)
    if guess is None:
        return challenger, max(support - votes, 0.0)
    if support > 0 and abs(guess - challenger) <= gate * math.sqrt(sigma2):
        return challenger, support + votes
    if challengers >= 4:
        return challenger if 0 < support and guess > challenger else guess, support + votes
    if support > 0 and guess > challenger:
        return challenger, support
    return guess, votes


def fuse_cell(
    cell,
    points,
    resolution,
    *,
    gate,
    max_gate_std,
    relief,
    scan_variance_floor,
    outlier_variance,
    max_support,
    min_above,
    max_above_per_scan,
    max_variance,
    edges,
    shown=(-math.inf, {}),
    challengers=0,
    settled=-math.inf,
):
    """One cell and the points of one scan: the cell after it, and the numbers of points used and ignored at a step.

    `cell` has elevation, variance, known, support, challenger, challenger_support and time;
    each point z, variance, ray, beyond. `relief` counts cells,
    `shown` are the highest mean height of the points in the eight cells around, and the heights of those cells,
    `challengers` how many there are in the 3 x 3 window, and `settled` its highest elevation of at least half of
    `max_support`.
    """
    after, relief = dict(cell), relief * resolution
    after["variance"] = min(cell["variance"], max_variance) if cell["known"] else cell["variance"]
    if not points:
        return after, 0, 0
    settings = dict(gate=gate, max_gate_std=max_gate_std, edges=edges)
    height, kept, ignored, for_cell, guess = scan_height(cell, points, relief, shown, **settings)
    R = max(1 / sum(1 / p["variance"] for p in kept), scan_variance_floor) if kept else 1e12
    gate_variance = min(cell["variance"], max_gate_std**2)
    of_all = max(1 / sum(1 / p["variance"] for p in points), scan_variance_floor)
    sigma2 = gate_variance + of_all + relief**2
    if guess is not None and settled >= guess - gate * math.sqrt(sigma2):
        guess = None  # the edge of a step that is known
    challenger, votes = challenge(cell, len(points), guess, sigma2, gate, challengers, min_above, max_above_per_scan)
    risen = guess is not None and votes >= min_above
    after |= dict(challenger=challenger, challenger_support=min(votes, min_above))
    if not kept:
        return after, 0, ignored
    distance = abs(height - cell["elevation"])
    agree = cell["known"] and distance <= gate * math.sqrt(gate_variance + R + relief**2)
    votes = len(kept) + ignored
    margin = 2 * votes - len(points)  # votes for the height, less votes against it
    support = cell["support"] + (margin if agree else for_cell - votes)
    if agree:
        h, variance = kalman(cell["elevation"], cell["variance"], [(height, R)])
        after |= dict(elevation=h, variance=min(variance, max_variance), time=0.0)
    elif not cell["known"] or support < 0 or risen:
        after |= dict(elevation=height, variance=min(R, max_variance), known=True, time=0.0)
        after["challenger_support"] = 0.0
        support = -support if cell["known"] and not risen else margin
    else:
        after["variance"] = min(cell["variance"] + outlier_variance * len(kept), max_variance)
        return after | dict(support=min(max(support, 0), max_support)), 0, ignored
    return after | dict(support=min(max(support, 0), max_support)), len(kept), ignored


# Time and drift -------------------------------------------------------------------------------------------------------


def age(variance, time, dt, rate):
    """sigma_m^2 += sigma_t^2 * dt; the time since the last hit grows."""
    variance, time = variance.copy(), time.copy()
    for cell in np.ndindex(variance.shape):
        variance[cell] += rate * dt
        time[cell] += dt
    return variance, time


def drift(layers, points, corner, resolution, *, sigma2, gate, relief, max_drift, min_points, gain, **cells):
    """Number of points, mean error and correction: e = (1/n) sum (p_z - h) over points on certain, flat cells.

    On a slope, h is the height of the cell's plane at the point. Points farther than `gate` standard deviations from
    the mean error count no more, sigma^2 = `sigma2` of the points + relief^2.
    """
    errors = [e for p in points if (e := height_error(layers, p, corner, resolution, **cells)) is not None]
    mean = sum(errors) / max(1, len(errors))
    errors = [e for e in errors if abs(e - mean) <= gate * math.sqrt(sigma2 + relief**2)]
    mean = sum(errors) / max(1, len(errors))
    return len(errors), mean, gain * mean if len(errors) >= min_points and abs(mean) <= max_drift else 0.0


def height_error(layers, point, corner, resolution, *, min_traversability, max_variance, max_error):
    """The height of a point over the map, or None where it cannot measure drift."""
    cell = cell_of(point[0], point[1], corner, resolution, layers["elevation"].shape)
    if cell is None or not layers["validity"][cell]:
        return None
    if layers["traversability"][cell] < min_traversability or layers["variance"][cell] > max_variance:
        return None
    x, y = center_of(*cell, corner, resolution)
    slope = layers["gradient_x"][cell] * (point[0] - x) + layers["gradient_y"][cell] * (point[1] - y)
    error = point[2] - layers["elevation"][cell] - slope
    return error if abs(error) <= max_error else None


# Cells ----------------------------------------------------------------------------------------------------------------


def ground_below(layers, base, corner, resolution, radius, height, max_base_height):
    """Height of the ground on which the robot stands [m], the base's where none is known.

    The weighted mean of the near cells at most `max_base_height` below the base, or of all below it that were hit now:
    if the former are the smaller part of what is below, or the latter are higher by half of `height`.
    """
    hit, within, total = [], [], 0.0
    for i, j in zip(*np.nonzero(layers["validity"]), strict=True):
        x, y = center_of(i, j, corner, resolution)
        d, z = math.hypot(x - base[0], y - base[1]), layers["elevation"][i, j]
        if d > radius or z > base[2]:
            continue
        weight = 1 / (d * d + 0.25) ** 2
        total += weight
        if layers["time"][i, j] == 0:
            hit.append((weight, z))
        if z >= base[2] - max_base_height:
            within.append((weight, z))
    of_hit, of_within = (
        sum(w * z for w, z in cells) / sum(w for w, _ in cells) if cells else None for cells in (hit, within)
    )
    larger = sum(w for w, _ in within) > total / 2
    if larger and (of_hit is None or of_hit <= of_within + height / 2):
        return of_within
    return base[2] if of_hit is None else of_hit


def clear_other_floors(layers, base, corner, resolution, *, radius, height, base_height, max_base_height):
    """validity and bounded after cells near the robot and far from its height are cleared; and how many were."""
    validity, bounded, cleared = layers["validity"].copy(), layers["bounded"].copy(), 0
    ground = ground_below(layers, base, corner, resolution, radius, height, max_base_height)
    flies = ground < base[2] - max_base_height
    robot = base[2] if flies else min(base[2], ground + base_height)

    def elsewhere(z, allowance):
        too_low = z < robot - height - allowance and not flies
        return too_low or (z > robot + height + allowance and z > base[2] + allowance)

    for i, j in np.ndindex(validity.shape):
        x, y = center_of(i, j, corner, resolution)
        d = math.hypot(x - base[0], y - base[1])
        if d > radius:
            continue
        hit = layers["time"][i, j] == 0
        if validity[i, j] and elsewhere(layers["elevation"][i, j], d * height / radius if hit else 0.0):
            validity[i, j] = bounded[i, j] = False
            cleared += 1
        elif bounded[i, j] and elsewhere(layers["upper_bound"][i, j], 0.0):
            bounded[i, j] = False
    return validity, bounded, cleared


def window(validity, i, j, radius):
    """The known cells within `radius` cells of a cell."""
    H, W = validity.shape
    rows, columns = range(max(0, i - radius), min(H, i + radius + 1)), range(max(0, j - radius), min(W, j + radius + 1))
    return [(a, b) for a in rows for b in columns if validity[a, b]]


def fit_plane(elevation, validity, i, j, radius, resolution):
    """Least-squares plane through the known cells around a cell: does it exist, its gradient, mean squared residual.

    Cells on one line leave the gradient across it open; the shortest gradient is taken.
    """
    cells = window(validity, i, j, radius)
    if not cells:
        return False, 0.0, 0.0, 0.0
    xy = np.array([((a - i) * resolution, (b - j) * resolution) for a, b in cells])
    z = np.array([elevation[c] for c in cells])
    A, b = xy - xy.mean(0), z - z.mean()
    gradient = np.linalg.lstsq(A, b, rcond=1e-6)[0]
    return spans_plane(cells, radius), gradient[0], gradient[1], float(np.mean((b - A @ gradient) ** 2))


def spans_plane(cells, radius):
    """Do cells spread across the line that fits them best: as two full rows, and by 0.4 of a full window, or more?"""
    across = np.linalg.eigvalsh(np.cov(np.array(cells, float).T, bias=True))[0]
    full = np.mean(np.arange(-radius, radius + 1.0) ** 2)
    return across >= max(0.25, 0.16 * full) - 1e-3


def step_at(elevation, validity, i, j, radius):
    """The largest height difference between a known cell and those around it."""
    return max(abs(elevation[c] - elevation[i, j]) for c in window(validity, i, j, radius))


def traversability(elevation, validity, i, j, resolution, *, radius, critical_slope, critical_step, critical_roughness):
    """1 - max(slope / critical, step / critical, roughness / critical), not below 0; `radius` in metres.

    None where the cells of the window do not span a plane. A step is a height difference within 0.1 m and the window.
    """
    cells = max(1, round(radius / resolution))
    spans, gx, gy, residual = fit_plane(elevation, validity, i, j, cells, resolution)
    if not spans:
        return None
    step = step_at(elevation, validity, i, j, min(cells, max(1, round(0.1 / resolution))))
    slope = math.atan(math.hypot(gx, gy))
    return max(0.0, 1 - max(slope / critical_slope, step / critical_step, math.sqrt(residual) / critical_roughness))


# Rays -----------------------------------------------------------------------------------------------------------------


def march(rays, corner, resolution, shape, steps_per_cell=4):
    """The lowest ray over each cell, by marching along every ray: heights (H, W), inf where none, and its direction.

    `rays` are (origin, hit) pairs. A ray counts up to one cell before its hit.
    """
    lowest, direction = np.full(shape, math.inf), np.zeros((*shape, 3))
    for origin, hit in rays:
        horizontal = math.hypot(hit[0] - origin[0], hit[1] - origin[1])
        unit = (hit - origin) / np.linalg.norm(hit - origin)
        for k in range(int((horizontal - resolution) / resolution * steps_per_cell)):
            x, y, z = origin + (k + 0.5) / steps_per_cell * resolution / horizontal * (hit - origin)
            cell = cell_of(x, y, corner, resolution, shape)
            if cell is not None and z < lowest[cell]:
                lowest[cell], direction[cell] = z, unit
    return lowest, direction


def over_centers(lowest, direction, origin, corner, resolution):
    """The heights over the cells' centres of the rays that are lowest in them."""
    height = lowest.copy()
    for i, j in zip(*np.nonzero(np.isfinite(lowest)), strict=True):
        x, y = center_of(i, j, corner, resolution)
        slope = direction[i, j][2] / math.hypot(direction[i, j][0], direction[i, j][1])
        height[i, j] = origin[2] + slope * math.hypot(x - origin[0], y - origin[1])
    return height


def well_supported(c, layers, resolution, min_support):
    """Whether enough points agree with a known cell, or with a known neighbour at a side, less than a cell higher."""

    def enough(a):
        return layers["validity"][a] and layers["support"][a] >= min_support

    H, W = layers["validity"].shape
    around = [(c[0] - 1, c[1]), (c[0] + 1, c[1]), (c[0], c[1] - 1), (c[0], c[1] + 1)]
    around = [a for a in around if 0 <= a[0] < H and 0 <= a[1] < W]
    like = [a for a in around if abs(layers["elevation"][a] - layers["elevation"][c]) <= resolution]
    return bool(layers["validity"][c]) and any(enough(a) for a in [c, *like])


def believed_slope(origin, hit, layers, corner, resolution, *, min_support, gate, near=1.0, clearance=0.05):
    """The slope dz/dr of a ray that ends in a well supported cell and not below it, or passes the last half cell so.

    None for others. For a ray that leaves the window otherwise, the lowest ground counts that is well supported, of the
    strip along the border that the ray leaves through, as deep as `near`, and so far to both sides. A ray that is never
    more than `clearance` below that is believed, and taken for one that passes `clearance` above it.
    """
    shape, share, side = layers["validity"].shape, 1.0, None
    if cell_of(*hit[:2], corner, resolution, shape) is None:
        for k in range(2):
            low, high = corner[k] * resolution, (corner[k] + shape[k]) * resolution
            border = high - resolution / 2 if hit[k] > origin[k] else low + resolution / 2
            if hit[k] != origin[k] and (border - origin[k]) / (hit[k] - origin[k]) < share:
                share, side = (border - origin[k]) / (hit[k] - origin[k]), k
    share, length = max(share, 0.0), math.hypot(*(hit - origin)[:2])
    x, y, z = origin + share * (hit - origin)
    slope, c = (hit - origin)[2] / length, cell_of(x, y, corner, resolution, shape)
    if c is None:
        return None
    if well_supported(c, layers, resolution, min_support):
        margin = gate * math.sqrt(layers["variance"][c] + (resolution / 2) ** 2)
        if z >= layers["elevation"][c] - margin:
            return slope
    if side is None:
        return None
    n, border = max(1, int(near / resolution)), shape[side] - 1 if hit[side] > origin[side] else 0
    strip = [
        layers["elevation"][a]
        for a in np.ndindex(shape)
        if abs(a[side] - border) < n and abs(a[1 - side] - c[1 - side]) <= n
        if well_supported(a, layers, resolution, min_support)
    ]
    if not strip or min(origin[2], hit[2]) < min(strip) - clearance:
        return None
    return (max(z, min(strip) + clearance) - origin[2]) / (share * length)


def stays_above_recent(origin, hit, layers, corner, resolution, *, min_time, gate):
    """Whether a ray passes over all ground hit of late, sampled every two cells up to two cells before its hit."""
    horizontal, step = math.hypot(hit[0] - origin[0], hit[1] - origin[1]), 2 * resolution
    for k in range(math.floor(horizontal / step)):
        x, y, z = origin + (k + 0.5) * step / horizontal * (hit - origin)
        c = cell_of(x, y, corner, resolution, layers["validity"].shape)
        if c is None or not layers["validity"][c] or layers["time"][c] > min_time:
            continue
        if z < layers["elevation"][c] - gate * math.sqrt(layers["variance"][c] + (resolution / 2) ** 2):
            return False
    return True


def clear_seen_through(layers, lowest, direction, resolution, *, min_time, min_incidence, gate):
    """validity, bounded and upper bound after rays: remove if p_z < h - sigma, not hit of late, |r . n| > alpha_n.

    Whatever the normal, also if p_z < h - gate * sqrt(sigma^2 + (cell / 2)^2) - |gradient| * cell / 2.
    """
    validity, bounded, bound = (layers[n].copy() for n in ("validity", "bounded", "upper_bound"))
    for c in np.ndindex(validity.shape):
        if not math.isfinite(lowest[c]):
            continue
        gx, gy, half = layers["gradient_x"][c], layers["gradient_y"][c], resolution / 2
        normal = np.array([-gx, -gy, 1.0])
        incidence = abs(direction[c] @ normal) / np.linalg.norm(normal)
        depth = layers["elevation"][c] - lowest[c]
        far = depth > gate * math.hypot(math.sqrt(layers["variance"][c]), half) + math.hypot(gx, gy) * half
        below = depth > math.sqrt(layers["variance"][c])
        if validity[c] and below and layers["time"][c] > min_time and (far or incidence > min_incidence):
            validity[c] = bounded[c] = False
        if not validity[c]:
            bound[c] = min(bound[c], lowest[c]) if bounded[c] else lowest[c]
            bounded[c] = True
    return validity, bounded & ~validity, bound


# Reading --------------------------------------------------------------------------------------------------------------


def sample(values, known, x, y, corner, resolution, mode):
    """The value of a layer at a position, and whether it is valid (then bilinear neighbours weigh at least a half)."""
    if mode == "nearest":
        cell = cell_of(x, y, corner, resolution, values.shape)
        return (values[cell], True) if cell is not None and known[cell] else (0.0, False)
    u, v = x / resolution - corner[0] - 0.5, y / resolution - corner[1] - 0.5
    total = weighted = 0.0
    for i in (math.floor(u), math.floor(u) + 1):
        for j in (math.floor(v), math.floor(v) + 1):
            if 0 <= i < values.shape[0] and 0 <= j < values.shape[1] and known[i, j]:
                weight = (1 - abs(u - i)) * (1 - abs(v - j))
                total, weighted = total + weight, weighted + weight * values[i, j]
    return (weighted / total, True) if total >= 0.5 else (0.0, False)


def nearest_foot(x, y, feet):
    """The height of the foot nearest to a position."""
    return min(feet, key=lambda f: math.hypot(f[0] - x, f[1] - y))[2]


def feet_plane(x, y, feet):
    """The height at a position of the least-squares plane through the feet."""
    A = np.column_stack([feet[:, :2], np.ones(len(feet))])
    return float(np.array([x, y, 1.0]) @ np.linalg.lstsq(A, feet[:, 2], rcond=None)[0])


# Sites ----------------------------------------------------------------------------------------------------------------


def information(height, time, rate):
    """1 / sigma^2 of a height at a later time; 0 without one. A height is a dict of h [m], v [m^2] and t [s]."""
    return 1.0 / (height["v"] + rate * (time - height["t"])) if height else 0.0


def fuse_site_cell(first, other, entries, rate, *, gate, max_gate_std, max_newer_ratio):
    """What a site's cell says after a merge, what contradicts that, and whether heights contradicted each other.

    Entries are heights with the relief [m^2] of their cell, and `contributed`, the same robot's earlier contribution.
    """
    limits = dict(rate=rate, gate=gate, max_gate_std=max_gate_std)
    fused, left, is_kept = average_site_cell(first, entries, None, **limits)
    if not left and is_kept:
        return fused, other, False
    fused, left, is_kept = average_site_cell(first, entries, surest, **limits)
    rest = left + ([] if is_kept else [{**first, "relief": 0.0, "contributed": None}])
    second, _, _ = average_site_cell(other, rest, surest, **limits, among_entries=True)
    is_new = len(left) < len(entries), bool(left)
    if second and replaces(second, fused, is_new, rate, max_newer_ratio):
        fused, second = second, fused
    return fused, second, True


def surest(heights, weights, mean):
    """The height of the most information; of several, the one nearest to the mean [mm], and then the lowest."""
    certain = [h for h, w in zip(heights, weights, strict=True) if w >= max(weights)]
    return min(certain, key=lambda h: (round(1e3 * abs(h - mean)), h))


def average_site_cell(prior, entries, choose, *, rate, gate, max_gate_std, among_entries=False):
    """The mean of what lies near the reference, the entries that do not, and whether the prior does."""
    if not entries:
        return prior, [], True
    newest = max(x["t"] for x in [*entries, prior or entries[0]])
    heights = [e["h"] for e in entries] + ([prior["h"]] if prior else [])
    weights = [information(e, newest, rate) for e in [*entries, *([prior] if prior else [])]]
    total = sum(weights)
    mean = sum(h * w for h, w in zip(heights, weights, strict=True)) / total
    eligible = weights[: len(entries)] if among_entries else weights
    reference = mean if choose is None else choose(heights[: len(eligible)], eligible, mean)

    def is_near(height, weight, relief):
        others = max(total - weight, 1e-6 * total)
        distance = (height - mean) * total / others if choose is None else height - reference
        variance = 1 / weight + 1 / (others if choose is None else max(eligible))
        return distance**2 <= gate**2 * (min(variance, max_gate_std**2) + relief)

    near = [e for e, w in zip(entries, weights, strict=False) if is_near(e["h"], w, e["relief"])]
    relief = max(e["relief"] for e in entries)
    is_kept = bool(prior) and is_near(prior["h"], weights[-1], relief)
    if not near:
        return prior, entries, is_kept or not prior
    own = information(prior, newest, rate) if is_kept else 0.0
    moment = own * (prior["h"] - reference) if is_kept else 0.0
    total = own + sum(information(e, newest, rate) for e in near)
    for e in near if is_kept else []:
        contributed = e["contributed"]
        if not contributed or (contributed["h"] - prior["h"]) ** 2 > gate**2 * (max_gate_std**2 + e["relief"]):
            continue
        new, before = information(e, newest, rate), information(contributed, newest, rate)
        total -= min(new, before)
        moment -= min(new, before) * ((e if before >= new else contributed)["h"] - reference)
    moment += sum(information(e, newest, rate) * (e["h"] - reference) for e in near)
    times = [e["t"] for e in near] + ([prior["t"]] if is_kept else [])
    left = [e for e in entries if not any(e is n for n in near)]
    return dict(h=reference + moment / total, v=1 / total, t=max(times)), left, is_kept or not prior


def replaces(other, first, is_new, rate, max_newer_ratio):
    """Whether a site is to say the other height: newer and about as sure, or as new and surer.

    Of the same time, one that holds what is merged now, `is_new` of the first and of the other, is newer.
    """
    newest = max(other["t"], first["t"])
    ratio = information(first, newest, rate) / information(other, newest, rate)
    ages = (first["t"], is_new[0]), (other["t"], is_new[1])
    if ages[0] == ages[1]:
        return ratio < 1
    return ratio < (max_newer_ratio if ages[1] > ages[0] else 1 / max_newer_ratio)
