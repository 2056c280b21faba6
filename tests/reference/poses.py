"""The uncertainty of poses, and motion within a scan."""

import math

import numpy as np

from tests.reference.body import rotation_of


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
