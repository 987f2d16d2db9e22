"""Rigid motions: weighted Kabsch with a prior, rotations, mirror. Twin of `jaxhand.geometry`.

Points are rows, rotations act on columns: `world = hand @ rotation.T + translation`.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from numpy_infer.arrays import Array, some

PRIOR_STRENGTH = 1e-6
"""m²: below this second singular value of the cross-covariance (points within about 1 mm of a
line) the prior decides what the points do not; above it, it has no say at all."""

_FOUR_ROWS, _FOUR_COLUMNS = np.divmod(np.arange(16), 4)
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
    return points @ rotation.swapaxes(-1, -2) + translation[..., None, :]


def untransform(rotation: Array, translation: Array, points: Array) -> Array:
    """`[..., N, 3]` points moved by the inverse of (`rotation`, `translation`)."""
    return (points - translation[..., None, :]) @ rotation


def mean_point(points: Array, weight: Array) -> Array:
    """`[..., 3]` weighted mean of `[..., N, 3]` points; the origin where all weights are 0."""
    return (_shares(weight) @ points)[..., 0, :]


def _shares(weight: Array) -> Array:
    """`[..., 1, N]` weights as parts of their sum; 0 where all are 0."""
    total = np.add.reduce(weight, -1, keepdims=True)
    return (weight / np.maximum(total, 1e-30))[..., None, :]


def second_extent(points: Array, weight: Array) -> Array:
    """`[...]` second singular value of the weighted, centred `[..., N, 3]` points, in metres: 0 for
    collinear points."""
    centred = (points - _shares(weight) @ points) * np.sqrt(weight)[..., None]
    return np.sqrt(np.maximum(np.linalg.eigvalsh(centred.swapaxes(-1, -2) @ centred)[..., 1], 0))


def squares(vectors: Array) -> Array:
    """`[...]` squares of the lengths of `[..., 3]`."""
    return (vectors * vectors) @ _ONES.astype(vectors.dtype, copy=False)


_ONES = np.ones(3)


def cross(a: Array, b: Array) -> Array:
    """`[..., 3]` cross product. `np.cross` does the same at ten times the cost for one pair."""
    return a[..., _NEXT] * b[..., _AFTER] - a[..., _AFTER] * b[..., _NEXT]


def determinant(matrix: Array) -> Array:
    """`[...]` determinant of `[..., 3, 3]`."""
    return (matrix[..., 0, :] * cross(matrix[..., 1, :], matrix[..., 2, :])).sum(-1)


def solve(matrix: Array, vector: Array) -> Array:
    """`[..., N]` x with `matrix @ x = vector`, for a symmetric positive `[..., N, N]` matrix."""
    return np.linalg.solve(matrix, vector[..., None])[..., 0]


class Pattern(NamedTuple):
    """Points that others are registered to, and what of them does not depend on those."""

    shares: Array
    """`[..., 1, N]` the weights as parts of their sum."""
    mean: Array
    """`[..., 1, 3]` metres."""
    spread: Array
    """`[..., N, 3]` the points from their mean, times their weights; metres."""


def pattern(source: Array, weight: Array) -> Pattern:
    """What `fit` needs of `source [..., N, 3]` and `weight [..., N]`, as `kabsch` takes them."""
    shares = _shares(weight)
    mean = shares @ source
    return Pattern(shares, mean, (source - mean) * weight[..., None])


def fit(
    source: Pattern, target: Array, prior: Array | Callable[[], Array]
) -> tuple[Array, Array, Array]:
    """`kabsch` of a pattern whose own part is done, which is half of the work.

    Returns:
        `rotation [..., 3, 3]`; `translation [..., 3]`; `[...]` the second singular value of the
        cross-covariance, m²: at most that of the target, times the pattern's largest.
    """
    mean = source.shares @ target
    covariance = (target - mean).swapaxes(-1, -2) @ source.spread
    values, quaternions = _horn(covariance)
    second = (values[..., 3] + values[..., 1]) / 2
    # Twice is enough: `prior_weight` measures at least 1/√3 of it.
    if some(second < 2 * PRIOR_STRENGTH):
        prior = prior() if callable(prior) else prior
        _, quaternions = _horn(covariance + prior_weight(covariance)[..., None, None] * prior)
    rotation = _rotation(quaternions)
    return rotation, (mean - source.mean @ rotation.swapaxes(-1, -2))[..., 0, :], second


class Folded(NamedTuple):
    """Several patterns that one set of points is registered to again and again."""

    shares: Array
    """`[..., 1, N]` of the first pattern: about their weighted mean points are centred."""
    table: Array
    """`[..., 3N, 19K]` from such points: of each of `K` patterns Horn's matrix, and how far its own
    mean is from there."""
    mean: Array
    """`[..., K, 3, 1]` metres: of the patterns' points."""


def folded(sources: Array, weights: Array) -> Folded:
    """Patterns of `sources [K, N, 3]` and `weights [..., K, N]`."""
    shares, mean, spread = pattern(sources, weights)
    batch, (count, points) = weights.shape[:-2], sources.shape[:2]
    # Of the entries of a cross-covariance, target by source, those of Horn's matrix.
    horn = (spread @ _OF_SOURCE.astype(spread.dtype, copy=False)).reshape(*spread.shape, 16)
    table = np.zeros((*batch, points, 3, count, 19), spread.dtype)
    table[..., :16] = horn.swapaxes(-4, -3).swapaxes(-3, -2)
    for axis in range(3):
        table[..., axis, :, 16 + axis] = shares[..., 0, :].swapaxes(-1, -2)
    table = table.reshape(*batch, 3 * points, 19 * count)
    return Folded(shares[..., 0, :, :], table, mean.swapaxes(-1, -2))


def refit(source: Folded, target: Array) -> tuple[Array, Array, Array]:
    """`fit` of target `[..., N, 3]` to several patterns at once, where no prior is needed: from
    rotations that come with too small a second singular value, below twice `PRIOR_STRENGTH`,
    nothing follows. Everything has `K` before its last axes."""
    mean = source.shares @ target
    batch, count = target.shape[:-2], source.mean.shape[-3]
    flat = (target - mean).reshape(*batch, 1, -1) @ source.table
    entries = flat.reshape(*batch, count, 19)
    symmetric = entries[..., :16].reshape(*batch, count, 4, 4)
    values, quaternions = np.linalg.eigh(symmetric)
    rotation = _rotation(quaternions)
    translation = mean + entries[..., 16:] - (rotation @ source.mean)[..., 0]
    return rotation, translation, (values[..., 3] + values[..., 1]) / 2


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
    return fit(pattern(source, weight), target, prior)[:2]


def prior_weight(covariance: Array) -> Array:
    """`[...]` how much of the prior to add to a `[..., 3, 3]` cross-covariance, in m²."""
    size = np.sqrt((covariance * covariance).sum((-1, -2)))
    # In parts of its size: its cofactors, squared, would overflow in float32.
    unit = covariance / np.where(size > 0, size, 1)[..., None, None]
    cofactors = cross(unit[..., _NEXT, :], unit[..., _AFTER, :])
    second = np.sqrt((cofactors * cofactors).sum((-1, -2))) * size
    return PRIOR_STRENGTH * np.maximum(0, 1 - second / PRIOR_STRENGTH) ** 2


def nearest_rotation(matrix: Array) -> Array:
    """`[..., 3, 3]` the rotation R that maximises tr(Rᵀ matrix) (Kabsch 1976; Umeyama 1991)."""
    return _rotation(_horn(matrix)[1])


def _horn(matrix: Array) -> tuple[Array, Array]:
    """Eigenvalues `[..., 4]`, growing, and eigenvectors `[..., 4, 4]` of Horn's (1987) symmetric
    matrix; the last vector is the quaternion, xyzw, of the nearest rotation. With the singular
    values a ≥ b ≥ c of `matrix`, c negative if its determinant is, the eigenvalues are a + b + c,
    a − b − c, b − a − c and c − a − b. Never a reflection, so cheaper than an SVD and its check."""
    flat = matrix.reshape(*matrix.shape[:-2], 9)
    symmetric = flat @ _HORN.astype(matrix.dtype, copy=False)
    return np.linalg.eigh(symmetric.reshape(*matrix.shape[:-2], 4, 4))


def _rotation(quaternions: Array) -> Array:
    """`[..., 3, 3]` of the last column, a unit quaternion xyzw, of `[..., 4, 4]`."""
    q = quaternions[..., 3]
    products = q.take(_FOUR_ROWS, -1) * q.take(_FOUR_COLUMNS, -1)
    return (products @ _OF_PRODUCTS.astype(q.dtype, copy=False)).reshape(*q.shape[:-1], 3, 3)


def _horn_entries() -> Array:
    """`[3, 3, 4, 4]` what each entry of a matrix adds to those of Horn's."""
    table = np.zeros((3, 3, 4, 4))
    for i, j, k in ((0, 1, 2), (1, 2, 0), (2, 0, 1)):
        table[i, i] = np.diag([1 if m in (i, 3) else -1 for m in range(4)])
        table[j, k, [j, k], [k, j]] = table[k, j, [j, k], [k, j]] = 1
        table[k, j, [i, 3], [3, i]], table[j, k, [i, 3], [3, i]] = 1, -1
    return table


_HORN = _horn_entries().reshape(9, 16)
_OF_SOURCE = _HORN.reshape(3, 3, 16).swapaxes(0, 1).reshape(3, 48)
"""`[3, 48]` the same from a source's entries: with those of the target, and Horn's matrix."""
_OF_PRODUCTS = _HORN.T.copy()
"""`[16, 9]` from the products of a quaternion's entries to its rotation: tr(Rᵀ matrix) = qᵀ K q."""


def rotation_from_vector(vector: Array) -> Array:
    """`[..., 3]` rotation vectors, radians → `[..., 3, 3]` (Rodrigues' formula). Right at and near
    no rotation, where the axis is not known: what it multiplies vanishes there."""
    angle: Array = np.sqrt((vector * vector).sum(-1, keepdims=True))
    axis = vector / np.where(angle > 0, angle, 1)
    basis = _CROSS_BASIS.astype(vector.dtype, copy=False)
    crossing = (axis @ basis).reshape(*vector.shape, 3)
    angle = angle[..., None]
    turned = np.sin(angle) * crossing + (1 - np.cos(angle)) * (crossing @ crossing)
    return turned + _EYE.astype(vector.dtype, copy=False)


_EYE = np.eye(3)
_CROSS_BASIS = np.cross(_EYE[:, None], -_EYE).reshape(3, 9)
"""`[3, 9]` a vector times this is its cross-product matrix."""


def shortest_arc(source: Array, target: Array, share: Array | None = None) -> Array:
    """`[..., 3, 3]` the least rotation that turns the direction of `source` into that of `target`,
    or the `share [...]` of it in 0 to 1.

    Vectors `[..., 3]` without length turn nothing. Between opposite ones every half turn is least:
    the one about the coordinate axis farthest from them, made perpendicular, is taken.

    No angle has to be known for it: the sum of the unit quaternions of no turn and of twice the arc
    has the direction of the arc's own.
    """
    lengths = np.sqrt(squares(source) * squares(target))
    turns = _cross_and_dot(source, target)
    turns[..., 3] += lengths
    if share is not None or np.count_nonzero(turns[..., 3] <= 0.75 * lengths):
        whole = np.ones_like(lengths) if share is None else share
        source, half_way, has_arc = _half_way(source, target, whole)
        turns = np.where(has_arc, _cross_and_dot(source, half_way), [0, 0, 0, 1])
        turns = turns.astype(source.dtype, copy=False)
    products = turns.take(_FOUR_ROWS, -1) * turns.take(_FOUR_COLUMNS, -1)
    rotation = products @ _WITH_SQUARE.astype(source.dtype, copy=False)
    return (rotation[..., :9] / rotation[..., 9:]).reshape(*turns.shape[:-1], 3, 3)


def _cross_and_dot(a: Array, b: Array) -> Array:
    """`[..., 4]` cross and scalar product of `[..., 3]`: of unit vectors the quaternion, xyzw, of
    twice the turn from one to the other."""
    products = a.take(_ROWS, -1) * b.take(_COLUMNS, -1)
    return products @ _CROSS_AND_DOT.astype(a.dtype, copy=False)


_ROWS, _COLUMNS = np.divmod(np.arange(9), 3)
_CROSS_AND_DOT = np.concatenate(
    [_CROSS_BASIS.reshape(3, 3, 3).swapaxes(1, 2).reshape(9, 3), _EYE.reshape(9, 1)], 1
)
"""`[9, 4]` from the products of two vectors' entries."""
_WITH_SQUARE = np.concatenate([_OF_PRODUCTS, np.eye(4).reshape(16, 1)], 1)
"""`[16, 10]` from the products of a quaternion's entries: its rotation times the square of its
length, and that square."""


def _half_way(source: Array, target: Array, share: Array) -> tuple[Array, Array, Array]:
    """Unit vectors `[..., 3]`: the source, and the middle of that share of the arc; and `[..., 1]`
    False where there is no arc."""
    has_arc = (_dot(source, source) > 0) & (_dot(target, target) > 0)
    source, target = _direction(source), _direction(target)
    cosine = _dot(source, target)
    aside = target - cosine * source
    sine = np.sqrt(_dot(aside, aside))
    farthest = _EYE.astype(source.dtype)[np.argmin(np.abs(source), -1)]
    across = farthest - _dot(farthest, source) * source
    aside = np.where((sine <= 1e-6) & (cosine < 0), across, aside)
    angle = share[..., None] * np.arctan2(sine, cosine) / 2
    # Once more: of nearly opposite ones `aside` is not quite perpendicular.
    half_way = _direction(np.cos(angle) * source + np.sin(angle) * _direction(aside))
    return source, half_way, has_arc


def _direction(vector: Array) -> Array:
    """`[..., 3]` with length 1; what has no length stays without."""
    length = np.sqrt(_dot(vector, vector))
    return vector / np.where(length > 0, length, 1)


def _dot(a: Array, b: Array) -> Array:
    """`[..., 1]` scalar products of `[..., 3]`."""
    return (a[..., None, :] @ b[..., None])[..., 0]


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
