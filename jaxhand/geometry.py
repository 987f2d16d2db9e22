"""Rigid motions: weighted Kabsch with a prior, rotations, mirror. Twin of `numpy_infer.geometry`.

Points are rows, rotations act on columns: `world = hand @ rotation.T + translation`.
"""

from __future__ import annotations

import operator
from collections.abc import Callable
from functools import reduce

import jax
import jax.numpy as jnp
import numpy as np

from jaxhand.compiled import apart
from numpy_infer.arrays import Array
from numpy_infer.geometry import PRIOR_STRENGTH

_NEXT, _AFTER = np.array([1, 2, 0]), np.array([2, 0, 1])


def product(a: Array, b: Array) -> Array:
    """Matrix product of small matrices, term by term: XLA fuses that into one loop over the batch.
    Batched `dot` is a call for each matrix, and a sum over a short axis a loop for each entry; and
    it stays float32 on devices whose `dot` would round to less."""
    terms = (a[..., :, k, None] * b[..., None, k, :] for k in range(a.shape[-1]))
    return reduce(operator.add, terms)


def inner(a: Array, b: Array) -> Array:
    """`[..., N, i]`, `[..., N, j]` → `[..., i, j]`: sums over the points, as `product` has them."""
    return product(a.swapaxes(-1, -2), b)


def mirror(points: Array) -> Array:
    """`[..., 3]` points reflected in the plane x = 0, exactly: a right hand becomes a left one."""
    return points * jnp.array([-1, 1, 1], points.dtype)


def mirror_rotation(rotation: Array) -> Array:
    """`[..., 3, 3]` the rotation that `mirror` makes of `rotation`, exactly."""
    sign = jnp.array([-1, 1, 1], rotation.dtype)
    return rotation * sign[:, None] * sign


def centre(points: Array, weight: Array) -> tuple[Array, Array]:
    """`[..., N, 3]` points from their weighted mean, and the mean `[..., 3]`.

    Centred twice: the first mean is rounded at the size of world coordinates, and in float32 that
    alone would lift three points out of their own plane.
    """
    mean = apart(mean_point(points, weight))
    centred = apart(points - mean[..., None, :])
    return apart(centred - mean_point(centred, weight)[..., None, :]), mean


def transform(rotation: Array, translation: Array, points: Array) -> Array:
    """`[..., N, 3]` points moved by `[..., 3, 3]`, `[..., 3]`: `points @ rotation.T + t`."""
    return product(points, jnp.swapaxes(rotation, -1, -2)) + translation[..., None, :]


def untransform(rotation: Array, translation: Array, points: Array) -> Array:
    """`[..., N, 3]` points moved by the inverse of (`rotation`, `translation`)."""
    return product(points - translation[..., None, :], rotation)


def mean_point(points: Array, weight: Array) -> Array:
    """`[..., 3]` weighted mean of `[..., N, 3]` points; the origin where all weights are 0."""
    total = jnp.maximum(weight.sum(-1)[..., None], 1e-30)
    return (points * weight[..., None]).sum(-2) / total


def second_extent(points: Array, weight: Array) -> Array:
    """`[...]` second singular value of the weighted, centred `[..., N, 3]` points, in metres: 0 for
    collinear points. The largest eigenvalue of the 3×3 scatter stands in closed form (Smith 1961);
    the second comes from it, trace and determinant: Smith's is 3 mm for a 20 cm line in float32."""
    centred = (points - mean_point(points, weight)[..., None, :]) * jnp.sqrt(weight)[..., None]
    scatter = apart(inner(centred, centred))
    mean = (scatter[..., 0, 0] + scatter[..., 1, 1] + scatter[..., 2, 2]) / 3
    deviation = scatter - mean[..., None, None] * jnp.eye(3, dtype=scatter.dtype)
    radius = jnp.sqrt((deviation * deviation).sum((-1, -2)) / 6)
    unit = deviation / jnp.where(radius > 0, radius, 1)[..., None, None]
    angle = jnp.arccos(jnp.clip(determinant(unit) / 2, -1, 1)) / 3
    largest = mean + 2 * radius * jnp.cos(angle)
    half = jnp.maximum(3 * mean - largest, 0) / 2
    product_of_two = determinant(scatter) / jnp.where(largest > 0, largest, 1)
    gap = half * half - jnp.clip(product_of_two, 0, half * half)
    return jnp.sqrt(half + jnp.sqrt(gap))


def cross(a: Array, b: Array) -> Array:
    """`[..., 3]` cross product. Written out, as in the twin, so that it fuses."""
    return a[..., _NEXT] * b[..., _AFTER] - a[..., _AFTER] * b[..., _NEXT]


def determinant(matrix: Array) -> Array:
    """`[...]` determinant of `[..., 3, 3]`."""
    return (matrix[..., 0, :] * cross(matrix[..., 1, :], matrix[..., 2, :])).sum(-1)


def solve(matrix: Array, vector: Array) -> Array:
    """`[..., N]` x with `matrix @ x = vector`, for a symmetric positive `[..., N, N]` matrix.
    Gauss-Jordan elimination, which needs no pivots there; LAPACK would be called for each matrix.
    """
    table = jnp.concatenate([matrix, vector[..., None]], -1)
    for k in range(matrix.shape[-1]):
        row = apart(table[..., k, :] / table[..., k, k, None])
        table = (table - table[..., :, k, None] * row[..., None, :]).at[..., k, :].set(row)
    return table[..., -1]


def kabsch(
    source: Array, target: Array, weight: Array, prior: Array | Callable[[], Array]
) -> tuple[Array, Array]:
    """Rigid motion that takes `source` to `target` with least weighted squares (paper, equation 2).

    Args:
        source: `[..., N, 3]` metres.
        target: `[..., N, 3]` metres.
        weight: `[..., N]`, not negative; points of weight 0 must be finite and do not matter.
        prior: `[..., 3, 3]` a rotation. What the points leave open (0, 1, 2 or collinear points)
            follows it, continuously: it enters with a strength that falls to 0 as the points
            spread out, see `PRIOR_STRENGTH`. It must turn with the data to keep equivariance. A
            function is called where it is needed.

    Returns:
        `rotation [..., 3, 3]` with determinant +1, `translation [..., 3]`. Without points the
        translation is 0.
    """
    source_mean, target_mean = apart((mean_point(source, weight), mean_point(target, weight)))
    centred = (target - target_mean[..., None, :]) * weight[..., None]
    covariance = apart(inner(centred, source - source_mean[..., None, :]))
    strength = prior_weight(covariance)[..., None, None]
    if callable(prior):
        eye = jnp.broadcast_to(jnp.eye(3, dtype=covariance.dtype), covariance.shape)
        prior = jax.lax.cond((strength > 0).any(), prior, lambda: eye)
    weighed = apart(covariance + strength * prior)
    rotation = apart(nearest_rotation(weighed))
    moved = product(rotation, source_mean[..., None])[..., 0]
    return apart((rotation, target_mean - moved))


def prior_weight(covariance: Array) -> Array:
    """`[...]` how much of the prior to add to a `[..., 3, 3]` cross-covariance, in m²."""
    size = jnp.sqrt((covariance * covariance).sum((-1, -2)))
    # In parts of its size: its cofactors, squared, would overflow in float32.
    unit = covariance / jnp.where(size > 0, size, 1)[..., None, None]
    cofactors = cross(unit[..., _NEXT, :], unit[..., _AFTER, :])
    second = jnp.sqrt((cofactors * cofactors).sum((-1, -2))) * size
    return PRIOR_STRENGTH * jnp.maximum(0, 1 - second / PRIOR_STRENGTH) ** 2


def nearest_rotation(matrix: Array) -> Array:
    """`[..., 3, 3]` the rotation R that maximises tr(Rᵀ matrix) (Kabsch 1976; Umeyama 1991).

    Not by SVD, which is a LAPACK call for each matrix. Horn's (1987) symmetric 4×4 matrix, whose
    leading eigenvector is the quaternion of R, is shifted to be positive and squared until that
    eigenvector alone is left. Its axes stand before the batch's, so that XLA runs along the batch.
    """
    size = jnp.sqrt((matrix * matrix).sum((-1, -2), keepdims=True))
    unit = matrix / jnp.where(size > 0, size, 1)
    (xx, xy, xz), (yx, yy, yz), (zx, zy, zz) = (
        [unit[..., i, j] for j in range(3)] for i in range(3)
    )
    # |unit| = 1, so the eigenvalues lie within ±√3 and a shift of 1.75 makes all of them positive.
    horn = (
        (xx - yy - zz + 1.75, xy + yx, xz + zx, zy - yz),
        (xy + yx, yy - xx - zz + 1.75, yz + zy, xz - zx),
        (xz + zx, yz + zy, zz - xx - yy + 1.75, yx - xy),
        (zy - yz, xz - zx, yx - xy, xx + yy + zz + 1.75),
    )
    projector = apart(jnp.stack([jnp.stack(row) for row in horn]))
    projector = jax.lax.fori_loop(0, 6, _to_the_sixteenth, projector)
    # Every column of the projector is the eigenvector; take the longest.
    pivot = jnp.argmax(jnp.stack([projector[i, i] for i in range(4)]), 0)
    q = tuple(jnp.select([pivot == i for i in range(4)], list(column)) for column in projector)
    return jnp.stack([jnp.stack(row, -1) for row in _rotation(_normalised(q))], -2)


def _to_the_sixteenth(_: int, matrix: Array) -> Array:
    """The 16th power, scaled to trace 1, of symmetric matrices `[4, 4, ...]`."""
    for _ in range(4):
        matrix = apart(reduce(operator.add, (matrix[:, k, None] * matrix[k] for k in range(4))))
    return matrix / apart(matrix[0, 0] + matrix[1, 1] + matrix[2, 2] + matrix[3, 3])


def _normalised(q: tuple[Array, ...]) -> tuple[Array, ...]:
    scale = 1 / jnp.sqrt(sum(entry * entry for entry in q))
    return tuple(entry * scale for entry in q)


def _rotation(q: tuple[Array, ...]) -> tuple[tuple[Array, ...], ...]:
    x, y, z, w = q
    return (
        (1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)),
        (2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)),
        (2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)),
    )


def rotation_from_vector(vector: Array) -> Array:
    """`[..., 3]` rotation vectors, radians → `[..., 3, 3]` (Rodrigues' formula). Right at and near
    no rotation, where the axis is not known: what it multiplies vanishes there."""
    angle = jnp.sqrt((vector * vector).sum(-1))[..., None, None]
    axis = vector / jnp.where(angle > 0, angle, 1)[..., 0]
    x, y, z = axis[..., 0], axis[..., 1], axis[..., 2]
    zero = jnp.zeros_like(x)
    rows = [[zero, -z, y], [z, zero, -x], [-y, x, zero]]
    crossing = jnp.stack([jnp.stack(row, -1) for row in rows], -2)
    turned = jnp.sin(angle) * crossing + (1 - jnp.cos(angle)) * product(crossing, crossing)
    return turned + jnp.eye(3, dtype=vector.dtype)


def shortest_arc(source: Array, target: Array, share: Array | None = None) -> Array:
    """`[..., 3, 3]` the least rotation that turns the direction of `source` into that of `target`,
    or the `share [...]` of it in 0 to 1.

    Vectors `[..., 3]` without length turn nothing. Between opposite ones every half turn is least:
    the one about the coordinate axis farthest from them, made perpendicular, is taken.

    Made of two reflections, across the source and across the direction half way to where it goes:
    no angle has to be known for it.
    """
    source, target = _direction(source), _direction(target)
    cosine = (source * target).sum(-1)[..., None]
    aside = target - cosine * source
    farthest = jnp.eye(3, dtype=source.dtype)[jnp.argmin(jnp.abs(source), -1)]
    across = farthest - (farthest * source).sum(-1)[..., None] * source
    sine = jnp.sqrt((aside * aside).sum(-1))[..., None]
    opposite = (sine <= 1e-6) & (cosine < 0)
    if share is None:
        half_way = jnp.where(opposite, across, source + target)
    else:
        angle = share[..., None] * jnp.arctan2(sine, cosine) / 2
        aside = _direction(jnp.where(opposite, across, aside))
        half_way = jnp.cos(angle) * source + jnp.sin(angle) * aside
    length = (source * source).sum(-1)[..., None] * (target * target).sum(-1)[..., None]
    half_way = _direction(half_way)
    there = 2 * (half_way * source).sum(-1)[..., None] * half_way - source
    half_way, there = (jnp.where(length > 0, part, source) for part in (half_way, there))
    turned = there[..., None] * source[..., None, :] - half_way[..., None] * half_way[..., None, :]
    return jnp.eye(3, dtype=source.dtype) + 2 * turned


def _direction(vector: Array) -> Array:
    """`[..., 3]` with length 1; what has no length stays without."""
    length = jnp.sqrt((vector * vector).sum(-1))[..., None]
    return vector / jnp.where(length > 0, length, 1)


def quaternion(rotation: Array) -> Array:
    """`[..., 4]` unit quaternion xyzw with w ≥ 0 of `[..., 3, 3]`.

    The largest of the four possible pivots is taken (Shepperd 1978), so no rotation is singular.
    """
    m = rotation
    trace = jnp.trace(m, axis1=-2, axis2=-1)
    diagonal = jnp.stack([m[..., 0, 0], m[..., 1, 1], m[..., 2, 2]], -1)
    squares = jnp.concatenate([1 + 2 * diagonal - trace[..., None], 1 + trace[..., None]], -1)
    xy, xw = m[..., 1, 0] + m[..., 0, 1], m[..., 2, 1] - m[..., 1, 2]
    xz, yw = m[..., 0, 2] + m[..., 2, 0], m[..., 0, 2] - m[..., 2, 0]
    yz, zw = m[..., 2, 1] + m[..., 1, 2], m[..., 1, 0] - m[..., 0, 1]
    s = jnp.moveaxis(squares, -1, 0)
    candidates = jnp.stack(
        [
            jnp.stack([s[0], xy, xz, xw], -1),
            jnp.stack([xy, s[1], yz, yw], -1),
            jnp.stack([xz, yz, s[2], zw], -1),
            jnp.stack([xw, yw, zw, s[3]], -1),
        ],
        -2,
    )
    pivot = jnp.argmax(squares, -1)
    q = jnp.take_along_axis(candidates, pivot[..., None, None], -2)[..., 0, :]
    q = q / jnp.sqrt((q * q).sum(-1, keepdims=True))
    return jnp.where(q[..., 3:] < 0, -q, q)
