"""Plain P3P by Grunert's quartic (Haralick et al., IJCV 1994), scores one match after the other, and refinement."""

import numpy as np


def p3p(points, keypoints):
    """Poses (S, 3, 4), S at most 4, of three points (3, 3) at keypoints (3, 2) on the plane at depth 1."""
    rays = np.column_stack([keypoints, np.ones(3)])
    rays /= np.linalg.norm(rays, axis=1, keepdims=True)
    a2, b2, c2 = (((points[i] - points[k]) ** 2).sum() for i, k in ((1, 2), (0, 2), (0, 1)))
    alpha, beta, gamma = (rays[i] @ rays[k] for i, k in ((1, 2), (0, 2), (0, 1)))
    d = (a2 - c2) / b2
    e = (a2 + c2) / b2
    quartic = [
        (d - 1) ** 2 - 4 * c2 / b2 * alpha**2,
        4 * (d * (1 - d) * beta - (1 - e) * alpha * gamma + 2 * c2 / b2 * alpha**2 * beta),
        2 * (d**2 - 1 + 2 * d**2 * beta**2 + 2 * (b2 - c2) / b2 * alpha**2 - 4 * e * alpha * beta * gamma
             + 2 * (b2 - a2) / b2 * gamma**2),
        4 * (-d * (1 + d) * beta + 2 * a2 / b2 * gamma**2 * beta - (1 - e) * alpha * gamma),
        (1 + d) ** 2 - 4 * a2 / b2 * gamma**2,
    ]  # fmt: skip
    poses = []
    for root in np.roots(quartic):
        if abs(root.imag) < 1e-6 * abs(root):
            v = root.real
            u = ((d - 1) * v**2 - 2 * d * beta * v + 1 + d) / (2 * (gamma - v * alpha))
            depth = np.sqrt(b2 / (1 + v**2 - 2 * v * beta))
            depths = depth * np.array([1, u, v])
            if (depths > 0).all():
                poses.append(_aligned(points, depths[:, None] * rays))
    return np.array(poses).reshape(-1, 3, 4)


def _aligned(points, in_camera):
    """Pose (3, 4) that moves points (3, 3) to others, by least squares (Kabsch)."""
    center, other = points.mean(0), in_camera.mean(0)
    u, _, vt = np.linalg.svd((in_camera - other).T @ (points - center))
    rotation = u @ np.diag([1, 1, np.linalg.det(u @ vt)]) @ vt
    return np.column_stack([rotation, other - rotation @ center])


def msac(pose, points, keypoints, focal):
    """Sum of squared errors, each at most 1, of points (M, 3) at keypoints (M, 2), in units of the focal lengths."""
    cost = 0.0
    for point, keypoint in zip(points, keypoints, strict=True):
        x, y, z = pose[:, :3] @ point + pose[:, 3]
        error = (np.array([x / z, y / z]) - keypoint) * focal
        cost += min(error @ error, 1.0) if z > 0 else 1.0
    return cost


def refine(pose, points, keypoints, focal, scale, steps):
    """Best pose (3, 4) of so many Gauss-Newton steps with Cauchy weights on the inliers, and its cost; see `msac`."""
    best, least = pose, np.inf
    for _ in range(steps):
        in_camera = points @ pose[:, :3].T + pose[:, 3]
        x, y, z = in_camera.T
        error = (in_camera[:, :2] / z[:, None] - keypoints) * focal
        squared = np.where(z > 1e-6, (error**2).sum(1), np.inf)
        relative = 1 + np.minimum(squared, 1) / scale**2
        cost = np.log(relative).sum()
        if cost < least:
            best, least = pose, cost
        none = np.zeros(len(points))
        by_point = focal * np.stack([1 / z, none, -x / z**2, none, 1 / z, -y / z**2], 1).reshape(-1, 2, 3)
        jacobian = np.concatenate([np.cross(in_camera[:, None], by_point), by_point], 2)[squared < 1].reshape(-1, 6)
        weight = np.repeat(1 / relative[squared < 1], 2)
        normal = (jacobian.T * weight) @ jacobian
        change = np.linalg.solve(normal, (jacobian.T * weight) @ error[squared < 1].ravel())
        half = np.cross(np.eye(3), change[:3]) / 2
        pose = np.linalg.solve(np.eye(3) + half, np.eye(3) - half) @ pose  # Cayley's rotation
        pose[:, 3] -= change[3:]
    return best, least
