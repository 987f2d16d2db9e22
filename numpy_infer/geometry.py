"""Rigid motions: weighted Kabsch with a prior, rotations, mirror. Twin of `jaxhand.geometry`.

Points are rows, rotations act on columns: `world = hand @ rotation.T + translation`.
"""

from __future__ import annotations

import numpy as np

from numpy_infer.arrays import Array

PRIOR_STRENGTH = 1e-6
"""m²: below this second singular value of the cross-covariance (points within about 1 mm of a
line) the prior decides what the points do not; above it, it has no say at all."""

_NEXT, _AFTER = np.array([1, 2, 0]), np.array([2, 0, 1])


def mirror(points: Array) -> Array:
    """`[..., 3]` points reflected in the plane x = 0, exactly: a right hand becomes a left one."""
    return points * np.array([-1, 1, 1], points.dtype)


def mirror_rotation(rotation: Array) -> Array:
    """`[..., 3, 3]` the rotation that `mirror` makes of `rotation`, exactly."""
    sign = np.array([-1, 1, 1], rotation.dtype)
    return rotation * sign[:, None] * sign


def centre(points: Array, weight: Array) -> tuple[Array, Array]:
    """`[..., N, 3]` points from their weighted mean, and the mean `[..., 3]`.

    Centred twice: the first mean is rounded at the size of world coordinates, and in float32 that
    alone would lift three points out of their own plane.
    """
    mean = mean_point(points, weight)
    centred = points - mean[..., None, :]
    return centred - mean_point(centred, weight)[..., None, :], mean


def transform(rotation: Array, translation: Array, points: Array) -> Array:
    """`[..., N, 3]` points moved by `[..., 3, 3]`, `[..., 3]`: `points @ rotation.T + t`."""
    return points @ np.swapaxes(rotation, -1, -2) + translation[..., None, :]


def untransform(rotation: Array, translation: Array, points: Array) -> Array:
    """`[..., N, 3]` points moved by the inverse of (`rotation`, `translation`)."""
    return (points - translation[..., None, :]) @ rotation


def mean_point(points: Array, weight: Array) -> Array:
    """`[..., 3]` weighted mean of `[..., N, 3]` points; the origin where all weights are 0."""
    total = weight.sum(-1)[..., None]
    return (points * weight[..., None]).sum(-2) / np.where(total > 0, total, 1)


def second_extent(points: Array, weight: Array) -> Array:
    """`[...]` second singular value of the weighted, centred `[..., N, 3]` points, in metres: 0 for
    collinear points. The largest eigenvalue of the 3×3 scatter stands in closed form (Smith 1961);
    the second comes from it, trace and determinant: Smith's is 3 mm for a 20 cm line in float32."""
    centred = (points - mean_point(points, weight)[..., None, :]) * np.sqrt(weight)[..., None]
    scatter = np.swapaxes(centred, -1, -2) @ centred
    mean = (scatter[..., 0, 0] + scatter[..., 1, 1] + scatter[..., 2, 2]) / 3
    deviation = scatter - mean[..., None, None] * np.eye(3, dtype=scatter.dtype)
    radius = np.sqrt((deviation * deviation).sum((-1, -2)) / 6)
    unit = deviation / np.where(radius > 0, radius, 1)[..., None, None]
    angle = np.arccos(np.clip(determinant(unit) / 2, -1, 1)) / 3
    largest = mean + 2 * radius * np.cos(angle)
    half = np.maximum(3 * mean - largest, 0) / 2
    product_of_two = determinant(scatter) / np.where(largest > 0, largest, 1)
    gap = half * half - np.clip(product_of_two, 0, half * half)
    return np.sqrt(half + np.sqrt(gap))


def cross(a: Array, b: Array) -> Array:
    """`[..., 3]` cross product. `np.cross` does the same at ten times the cost for one pair."""
    return a[..., _NEXT] * b[..., _AFTER] - a[..., _AFTER] * b[..., _NEXT]


def determinant(matrix: Array) -> Array:
    """`[...]` determinant of `[..., 3, 3]`."""
    return (matrix[..., 0, :] * cross(matrix[..., 1, :], matrix[..., 2, :])).sum(-1)


def solve(matrix: Array, vector: Array) -> Array:
    """`[..., 3]` x with `matrix @ x = vector`, for a symmetric positive `[..., 3, 3]` matrix."""
    return np.linalg.solve(matrix, vector[..., None])[..., 0]


def kabsch(source: Array, target: Array, weight: Array, prior: Array) -> tuple[Array, Array]:
    """Rigid motion that takes `source` to `target` with least weighted squares (paper, equation 2).

    Args:
        source: `[..., N, 3]` metres.
        target: `[..., N, 3]` metres.
        weight: `[..., N]`, not negative; points of weight 0 must be finite and do not matter.
        prior: `[..., 3, 3]` a rotation. What the points leave open (0, 1, 2 or collinear points)
            follows it, continuously: it enters with a strength that falls to 0 as the points
            spread out, see `PRIOR_STRENGTH`. It must turn with the data to keep equivariance.

    Returns:
        `rotation [..., 3, 3]` with determinant +1, `translation [..., 3]`. Without points the
        translation is 0.
    """
    source_mean, target_mean = mean_point(source, weight), mean_point(target, weight)
    centred = (target - target_mean[..., None, :]) * weight[..., None]
    covariance = np.swapaxes(centred, -1, -2) @ (source - source_mean[..., None, :])
    rotation = nearest_rotation(covariance + prior_weight(covariance)[..., None, None] * prior)
    return rotation, target_mean - (rotation @ source_mean[..., None])[..., 0]


def prior_weight(covariance: Array) -> Array:
    """`[...]` how much of the prior to add to a `[..., 3, 3]` cross-covariance, in m²."""
    cofactors = cross(covariance[..., _NEXT, :], covariance[..., _AFTER, :])
    size = np.sqrt((covariance * covariance).sum((-1, -2)))
    second = np.sqrt((cofactors * cofactors).sum((-1, -2))) / np.where(size > 0, size, 1)
    return PRIOR_STRENGTH * np.maximum(0, 1 - second / PRIOR_STRENGTH) ** 2


def nearest_rotation(matrix: Array) -> Array:
    """`[..., 3, 3]` the rotation R that maximises tr(Rᵀ matrix) (Kabsch 1976; Umeyama 1991)."""
    left, _, right = np.linalg.svd(matrix)
    proper = left @ right
    flip = np.where(determinant(proper) < 0, 2, 0).astype(matrix.dtype)[..., None, None]
    return proper - flip * (left[..., :, 2:] @ right[..., 2:, :])


def quaternion(rotation: Array) -> Array:
    """`[..., 4]` unit quaternion xyzw with w ≥ 0 of `[..., 3, 3]`.

    The largest of the four possible pivots is taken (Shepperd 1978), so no rotation is singular.
    """
    m = rotation
    trace = np.trace(m, axis1=-2, axis2=-1)
    diagonal = np.stack([m[..., 0, 0], m[..., 1, 1], m[..., 2, 2]], -1)
    squares = np.concatenate([1 + 2 * diagonal - trace[..., None], 1 + trace[..., None]], -1)
    xy, xw = m[..., 1, 0] + m[..., 0, 1], m[..., 2, 1] - m[..., 1, 2]
    xz, yw = m[..., 0, 2] + m[..., 2, 0], m[..., 0, 2] - m[..., 2, 0]
    yz, zw = m[..., 2, 1] + m[..., 1, 2], m[..., 1, 0] - m[..., 0, 1]
    s = np.moveaxis(squares, -1, 0)
    candidates = np.stack(
        [
            np.stack([s[0], xy, xz, xw], -1),
            np.stack([xy, s[1], yz, yw], -1),
            np.stack([xz, yz, s[2], zw], -1),
            np.stack([xw, yw, zw, s[3]], -1),
        ],
        -2,
    )
    pivot = np.argmax(squares, -1)
    q = np.take_along_axis(candidates, pivot[..., None, None], -2)[..., 0, :]
    q = q / np.sqrt((q * q).sum(-1, keepdims=True))
    return np.where(q[..., 3:] < 0, -q, q)
